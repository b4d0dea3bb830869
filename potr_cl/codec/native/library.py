"""The compiled library: its functions for NumPy arrays (:class:`Functions`), and if they are taken (:func:`native`).

C trusts the sizes that it is told. They are read off the arrays here, and arrays of another type, shape or layout than
a function takes are refused before it is called.
"""

from __future__ import annotations

import ctypes
import importlib.machinery
import logging
import os
import sys
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.bundles import BundledFile, SectionWords, native_steps
from potr_cl.codec.native.bundles_encode import BundleEncoder
from potr_cl.codec.native.declarations import address, declared
from potr_cl.codec.native.octree import OctreeBuilding, OctreeFunctions
from potr_cl.codec.native.quantising import Quantising
from potr_cl.codec.native.values import BundleShare
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.errors import UsageError

I8 = NDArray[np.int8]
I32 = NDArray[np.int32]

#: Levels are below this, so that sums of three fit.
_MEDIUM = 1 << 29


class Functions:
    """What the library offers. All of it may be called from several threads at a time, and leaves the interpreter free.

    Args:
        path: of the library.

    Attributes:
        quantising: those of the encoder that are about splats, and not about integers.
        octree: those about positions. octree_build: those of the encoder.

    Raises:
        OSError: it cannot be loaded.
        AttributeError: one is missing.
    """

    def __init__(self, path: str) -> None:
        self._c = declared(path)
        self.quantising = Quantising(self._c)
        self.octree = OctreeFunctions(self._c)
        self.octree_build = OctreeBuilding(self._c)

    def bundled_file(
        self, splats: int, sections: Mapping[int, SectionWords], steps: ColourSteps | None, vectors: bool = True
    ) -> BundledFile:
        """Sections of bundles, as :class:`potr_cl.codec.native.bundles.BundledFile` takes them."""
        return BundledFile(self._c, splats, sections, steps, vectors)

    def bundle_share(self, bundles: int) -> BundleShare:
        """So many bundles to decode, as :class:`potr_cl.codec.native.values.BundleShare` takes them."""
        return BundleShare(self._c, bundles)

    def bundle_encoder(self, *integers: Any) -> BundleEncoder:
        """Integers to code, as :class:`potr_cl.codec.native.bundles_encode.BundleEncoder` takes them."""
        return BundleEncoder(self._c, *integers)

    def step_classes(self, steps: ColourSteps, scales: I32, opacities: I32) -> tuple[I8, I8]:
        """(N,) classes of the steps of DC, and of AC.

        Args:
            steps: of colours.
            scales: (3, N) levels, 0 to 2^29 - 1.
            opacities: (N,) levels, 0 to 2^29 - 1.
        """
        n = len(opacities)
        for levels in (scales, opacities):
            if int(levels.min(initial=0)) < 0 or int(levels.max(initial=0)) >= _MEDIUM:
                raise TypeError("the native path was given levels that are negative or too large")
        dc, ac = np.empty((2, n), np.int8)
        self._c["potr_steps_classes"](
            ctypes.byref(native_steps(steps, n)),
            address(scales, np.int32, 3 * n),
            address(opacities, np.int32, n),
            n,
            address(dc, np.int8, n, True),
            address(ac, np.int8, n, True),
        )
        return dc, ac


_log = logging.getLogger("potr_cl")

#: The environment variable: "0" takes NumPy always, "1" refuses to go on without the library.
VARIABLE = "POTR_CL_NATIVE"
#: Another library than the one that was built with the package, such as one with a sanitizer.
LIBRARY_VARIABLE = "POTR_CL_NATIVE_LIBRARY"
#: "0": without what only some processors have, as on all others.
VECTORS_VARIABLE = "POTR_CL_NATIVE_VECTORS"


def native() -> Functions | None:
    """The library's functions; None where NumPy is to be taken.

    Raises:
        UsageError: ``POTR_CL_NATIVE`` asks for a library that is not there, or is not 0 or 1.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "0", "1"):
        raise UsageError(
            f"{VARIABLE} is '{asked}': set it to 0 for NumPy, to 1 for the compiled library, or not at all"
        )
    if asked == "0":
        return None
    functions = _loaded(os.environ.get(LIBRARY_VARIABLE) or _found())
    if functions is None and not asked:
        _tell_once()
    if functions is None and asked == "1":
        raise UsageError(
            f"{VARIABLE} is 1, but the compiled library is missing: unset it, or install potr_cl with a C compiler"
        )
    return functions


def vectors() -> bool:
    """Whether the library may use vectors of 512 bits, where the processor has them."""
    return os.environ.get(VECTORS_VARIABLE) != "0"


@lru_cache(maxsize=1)
def _tell_once() -> None:
    _log.warning(
        "the compiled codec is missing, so NumPy does its work, several times slower: in a clone run `python -m "
        "tools.make.native`, else install potr_cl with a C compiler; %s=0 says that this is wanted",
        VARIABLE,
    )


_paths: list[str] = []


def _found() -> str | None:
    """The library beside this file, which is looked for until it is there: decoders ask some fifty times a file."""
    if not _paths and (path := _built()) is not None:
        _paths.append(path)
    return _paths[0] if _paths else None


def _built() -> str | None:
    for suffix in importlib.machinery.EXTENSION_SUFFIXES:
        path = Path(__file__).with_name(f"_library{suffix}")
        if path.is_file():
            return str(path)
    return None


@lru_cache(maxsize=4)
def _loaded(path: str | None) -> Functions | None:
    if path is None or sys.byteorder != "little":
        return None
    try:
        return Functions(path)
    except (OSError, AttributeError):  # for another machine, or of another version of the package
        return None
