"""The C functions for NumPy arrays: :class:`Functions`.

C trusts the sizes that it is told. They are read off the arrays here, and arrays of another type, shape or layout than
a function takes are refused before it is called.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.arrays import address
from potr_cl.codec.native.bundles import BundledFile, SectionWords, native_steps
from potr_cl.codec.native.bundles_encode import BundleEncoder
from potr_cl.codec.native.declarations import declared
from potr_cl.codec.native.octree import OctreeFunctions
from potr_cl.codec.native.octree_build import OctreeBuilding
from potr_cl.codec.native.quantising import Quantising
from potr_cl.codec.native.share import BundleShare
from potr_cl.codec.steps.rule import ColourSteps

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
        """So many bundles to decode, as :class:`potr_cl.codec.native.share.BundleShare` takes them."""
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
