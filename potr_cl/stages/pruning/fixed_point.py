"""Removal effects and importances as integers: sums of integers do not depend on the order of their terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.raster.view_set import TILE

F64 = NDArray[np.float64]

_CHANNELS = 3
#: Effects of this a pixel and channel, in every tile of every view, still fit the 62 bits that the kernels can add.
_LARGEST_EFFECT = 16.0


@dataclass(frozen=True)
class FixedPoint:
    """The units in which the kernels add up (cl/prune/removal.clh).

    Views of different sizes count the same: each is scaled to the size of the largest.

    Attributes:
        scale: a sum over a tile's pixels is multiplied by this (and its view's :meth:`weight`) before its fraction is
            cut off.
        bound: a tile's sums in the largest view are cut at this, so that absurd colours do not overflow the totals.
        pixels: of the largest view.
        views: number of views.
    """

    scale: float
    bound: float
    pixels: int
    views: int

    @classmethod
    def of_views(cls, cameras: Sequence[Camera]) -> FixedPoint:
        """The finest units in which the totals of these views cannot overflow."""
        # At least the pixels of all tiles of a view.
        area = max((c.width + TILE - 1) * (c.height + TILE - 1) for c in cameras)
        # scale * views * tiles * bound <= 2^62, where bound is 48 a pixel: 60 bits and 12 say the same.
        scale = float(2.0 ** np.floor(60 - np.log2(12.0 * area * len(cameras))))
        pixels = max(c.width * c.height for c in cameras)
        return cls(scale, _CHANNELS * _LARGEST_EFFECT * TILE * TILE, pixels, len(cameras))

    def weight(self, pixels: int) -> float:
        """By how much the sums of a view of so many pixels are scaled up."""
        return self.pixels / pixels

    @property
    def units(self) -> tuple[float, float]:
        """ΔMSE and I of 1 in the totals."""
        importance = 1 / (self.scale * self.pixels * self.views)
        return importance / _CHANNELS, importance

    def values(self, totals: NDArray[np.int64]) -> tuple[F64, F64]:
        """ΔMSE and I, (N,) float64 each, of totals, (N, 2) int64."""
        one = self.scale * self.pixels * self.views
        effects = totals[:, 0] / one
        effects /= _CHANNELS
        return effects, totals[:, 1] / one


def zero_totals(stride: int) -> NDArray[np.uint32]:
    """(stride, 4) zeros: each splat's two totals, as the kernels' pairs of words."""
    return np.zeros((stride, 4), np.uint32)
