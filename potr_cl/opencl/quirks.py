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

#: All of the above by name, as docs/architecture.md lists them.
ALL = {name: value for name, value in list(globals().items()) if isinstance(value, Quirk)}
