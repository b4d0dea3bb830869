"""Whom each workaround concerns, by the names that the runtimes give themselves: they need not be installed."""

from __future__ import annotations

import pytest

from potr_cl.opencl import quirks

#: Platform and version of runtimes.
RUNTIMES = {
    "Intel": ("Intel(R) OpenCL", "OpenCL 3.0 LINUX"),
    "NVIDIA": ("NVIDIA CUDA", "OpenCL 3.0 CUDA 12.4.131"),
    "PoCL 3": ("Portable Computing Language", "OpenCL 3.0 PoCL 3.0-rc2  Linux, Release, RELOC, LLVM 14.0.6, SLEEF"),
    "PoCL 4": ("Portable Computing Language", "OpenCL 3.0 PoCL 4.0  Linux, Release, RELOC, LLVM 15.0.7, SLEEF"),
    "rusticl": ("rusticl", "OpenCL 3.0"),
    "Oclgrind": ("Oclgrind", "OpenCL 1.2 (Oclgrind 21.10)"),
    "FPGA emulation": ("Intel(R) FPGA Emulation Platform for OpenCL(TM)", "OpenCL 1.2 Intel(R) FPGA SDK"),
}

#: The runtimes that each quirk concerns.
CONCERNED = {
    "ONE_QUEUE": {"rusticl"},
    "NO_WIDE_VECTORS": {"PoCL 3"},
    "UNKNOWN_CPU": {"PoCL 3", "PoCL 4"},
    "CRASHES": {"PoCL 3", "PoCL 4"},
    "SHORT_LOOPS": {"rusticl"},
    "SIMULATOR": {"Oclgrind", "FPGA emulation"},
    "SMALL_GROUPS": {"PoCL 3", "PoCL 4"},
    "CALLED_BUILTINS": {"PoCL 3", "PoCL 4"},
    "NO_PREFETCH": {"NVIDIA", "Oclgrind"},
    "SHORT_FILLS": {"NVIDIA"},
    "WAITING_FREES": {"NVIDIA"},
    "CAREFUL_VECTORISER": {"Intel"},
}


@pytest.mark.parametrize("name", quirks.ALL)
def test_a_quirk_concerns_these_runtimes_and_no_others(name):
    assert {runtime for runtime in RUNTIMES if quirks.ALL[name].concerns(*RUNTIMES[runtime])} == CONCERNED[name]
