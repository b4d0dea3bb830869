"""The GPU programs for GPUs that nobody has here."""

from __future__ import annotations

import pytest

from tests.reference.gpu_programs import gpu_programs, gpu_sources, undeclared
from tools.stress import offline

#: The ones whose registers are short.
_LARGEST = (
    "refit/blocks.cl",
    "refit/rounding.cl",
    "refit/gather.cl",
    "refit/refit_gpu.cl",
    "prune/removal_gpu.cl",
    "fit/derivatives_gpu.cl",
)


def test_every_file_declares_its_programs() -> None:
    for source in gpu_sources():
        declared = list(gpu_programs(source))
        assert declared, source
        assert all(undeclared(source, program) is None for program in declared)


def test_what_is_not_declared_is_found() -> None:
    assert undeclared("refit/blocks.cl", {"LANES": "1", "SH_COUNT": "16"}) is None
    assert undeclared("refit/blocks.cl", {"LANES": "2", "SH_COUNT": "16"}) is not None
    assert undeclared("refit/blocks.cl", {"LANES": "1"}) is not None
    assert undeclared("refit/refit_cpu.cl", {"LANES": "8"}) is None


needs_clang = pytest.mark.skipif(offline.clang() is None, reason="clang and libclc are not installed")


@needs_clang
@pytest.mark.slow
@pytest.mark.parametrize("source", gpu_sources())
def test_opencl_c_without_extensions(source) -> None:
    for program in offline.programs(source):
        offline.measure(program, offline.APPLE)


@needs_clang
@pytest.mark.slow
@pytest.mark.parametrize("source", _LARGEST)
def test_nothing_is_spilled(source) -> None:
    uses = offline.measure(offline.programs(source)[-1], "gfx1100")
    assert uses
    assert all(use.scratch == 0 and use.waves >= 4 for use in uses.values()), uses


@pytest.mark.skipif(not set(offline.INTEL) & set(offline.available()), reason="Intel's ocloc is not installed")
@pytest.mark.slow
@pytest.mark.parametrize("source", _LARGEST)
def test_intel_gpus_spill_nothing(source) -> None:
    for target in ("dg2", "pvc"):
        uses = offline.measure(offline.programs(source, target)[-1], target)
        assert uses
        assert all(use.scratch == 0 for use in uses.values()), (target, uses)


@needs_clang
def test_a_program_that_is_refused_is_told(tmp_path) -> None:
    with pytest.raises(offline.OfflineError, match=r"refit/blocks.cl LANES=1 does not compile for gfx1100"):
        offline.measure(offline.Program("refit/blocks.cl", (("LANES", "1"),)), "gfx1100")
