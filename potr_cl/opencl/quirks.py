"""Workarounds for single vendors' runtimes: why each is there, whom it concerns, how to see whether it is still needed.

A workaround anywhere else in the code asks the quirk here whether it applies. To add one: a :class:`Quirk` below, and
the line that asks it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Quirk:
    """One workaround.

    Attributes:
        vendor: whose runtime it is.
        versions: in which it was seen.
        reason: what goes wrong without the workaround.
        still_needed: how to see whether a newer version still needs it.
        test: tells from a platform's name and version, both in lower case, whether it is concerned.
    """

    vendor: str
    versions: str
    reason: str
    still_needed: str
    test: Callable[[str, str], bool]

    def concerns(self, platform: str, version: str) -> bool:
        """Whether a platform of this name and version needs the workaround."""
        return self.test(platform.lower(), version.lower())


def is_pocl(platform: str) -> bool:
    """Whether a platform of this name is PoCL."""
    return "portable computing language" in platform.lower()


def _llvm_before_15(platform: str, version: str) -> bool:
    llvm = re.search(r"llvm (\d+)", version)
    return llvm is not None and int(llvm[1]) < 15


#: Results go through one command queue.
ONE_QUEUE = Quirk(
    vendor="Mesa rusticl",
    versions="22.3",
    reason="what one queue has finished is not there for another queue, silently: removal sweeps and compaction were "
    "wrong",
    still_needed="have `concerns` return False and run tests/stages on rusticl (RUSTICL_ENABLE=llvmpipe)",
    test=lambda platform, version: "rusticl" in platform,
)

#: Vectors of 16 floats are not even tried.
NO_WIDE_VECTORS = Quirk(
    vendor="PoCL",
    versions="3.0 on LLVM 14 and older, seen on a CPU with AVX-512",
    reason='the compiler ends the whole process, where no trial can catch it: "Do not know how to scalarize this '
    "operator's operand\"",
    still_needed="have `concerns` return False and run `python -m potr_cl devices --check`",
    test=_llvm_before_15,
)

#: An empty program is compiled before the device is believed to work.
UNKNOWN_CPU = Quirk(
    vendor="PoCL",
    versions="3.0 (the PyPI wheel) on CPUs newer than its LLVM",
    reason="it offers a CPU that it does not know and then refuses every program (\"unknown target CPU 'generic'\")",
    still_needed="`python -m potr_cl devices` on a machine whose CPU is newer than the runtime",
    test=lambda platform, version: is_pocl(platform),
)

#: It is tried in another process before it is taken (opencl/verdict.py).
CRASHES = Quirk(
    vendor="PoCL",
    versions="3.0 (the PyPI wheel), on an AMD EPYC of family 25, model 17",
    reason="a kernel of the re-fit ends the process with SIGSEGV, though each that was probed computed right",
    still_needed="`python -m potr_cl devices --check` with that runtime on such a CPU",
    test=lambda platform, version: is_pocl(platform),
)

#: The device runs the GPU kernels, which need no long loops. It asks for scalars, by which it is known; nothing else
#: has to ask this quirk.
SHORT_LOOPS = Quirk(
    vendor="Mesa llvmpipe",
    versions="22.3",
    reason="every loop ends after 65,535 rounds: too few for one work-item a tile",
    still_needed='open the device with family="cpu" and run tests/raster',
    test=lambda platform, version: "rusticl" in platform,
)

#: It is chosen last.
SIMULATOR = Quirk(
    vendor="Oclgrind, Intel's FPGA emulation",
    versions="all",
    reason="simulators are hundreds of times as slow as any other device",
    still_needed="always",
    test=lambda platform, version: "oclgrind" in platform or "fpga emulation" in platform,
)

#: Work-groups of the CPU kernels have one work-item, and those of the kernels on splats a fixed size
#: (raster/launcher.py, raster/scene_buffers.py, stages/pruning/sweep.py). Harmless elsewhere, so nobody asks.
SMALL_GROUPS = Quirk(
    vendor="PoCL",
    versions="3.0 and 3.1",
    reason="it keeps the private memory of a whole work-group on its stack, and makes groups of thousands of "
    "work-items where it may choose: the stack overflows",
    still_needed="let the launchers of CPU kernels take groups of 64 and run tests/raster",
    test=lambda platform, version: is_pocl(platform),
)

#: ``MAD``, ``LESSER`` and ``GREATER`` of cl/include/lanes.clh stand in for built-in functions. As fast elsewhere.
CALLED_BUILTINS = Quirk(
    vendor="PoCL",
    versions="3.0 and 3.1",
    reason="built-in functions such as mad and fma stay calls: they alone doubled a kernel's time",
    still_needed="make MAD the function mad and run tools.bench.rasterizer",
    test=lambda platform, version: is_pocl(platform),
)

#: cl/include/subtile_vectors.clh prefetches only where this macro of NVIDIA's is not defined.
NO_PREFETCH = Quirk(
    vendor="NVIDIA, Oclgrind",
    versions="driver 580; 21.10",
    reason="NVIDIA's compiler says that it knows __builtin_prefetch, and fails; Oclgrind does not know it",
    still_needed='build raster/composite_cpu.cl there without the test of __NV_CL_C_VERSION (Device(family="cpu"))',
    test=lambda platform, version: "nvidia" in platform or "oclgrind" in platform,
)

#: Buffers of more than a gigabyte are filled by a kernel. Right everywhere, so nothing asks for it.
SHORT_FILLS = Quirk(
    vendor="NVIDIA",
    versions="driver 580",
    reason="a fill that begins or ends some gigabytes behind a buffer's beginning writes elsewhere, or ends the queue",
    still_needed="fill a buffer of 20 GB in one call, and 1 MB at 12 GB, and read both back",
    test=lambda platform, version: "nvidia" in platform,
)

#: The queue is waited for first: other threads of Python run meanwhile.
WAITING_FREES = Quirk(
    vendor="NVIDIA",
    versions="driver 580",
    reason="to give memory back that is in use waits for the device, and all threads of Python wait with it",
    still_needed="free a buffer that a long kernel uses, and see whether another thread runs meanwhile",
    test=lambda platform, version: "nvidia" in platform,
)

#: cl/compact/ridge.cl asks how many views a splat has, not its number alone, before a work-item ends early, and reads
#: an element of a private array before it chooses. Both are right everywhere.
CAREFUL_VECTORISER = Quirk(
    vendor="Intel's CPU runtime",
    versions="2026.2",
    reason="a work-group that is cut short by work-items' numbers runs through scalar code, which rounds differently; "
    "a choice between elements of private arrays gives all work-items what the first one reads",
    still_needed="write both the short way and run tests/stages/test_compaction.py",
    test=lambda platform, version: "intel" in platform and "fpga" not in platform,
)

#: All of the above by name, as docs/architecture.md lists them.
ALL = {name: value for name, value in list(globals().items()) if isinstance(value, Quirk)}
