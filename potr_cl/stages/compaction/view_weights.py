"""How much each splat shows in each view: what the compaction weights its colours by."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera

#: Weights are in pixels of an image of this many: lambda then means the same whatever size the views are rendered at.
#: Half a megapixel is about the size of the images on which the paper's figures for lambda were measured.
REFERENCE_PIXELS = 500_000


def pixel_weight(camera: Camera) -> float:
    """What a pixel of a view counts, so that all views count the same whatever their size."""
    return REFERENCE_PIXELS / (camera.width * camera.height)


#: The largest weight whose squares and sums stay finite in single precision.
_LARGEST_WEIGHT = 1e12
#: Splats whose view weights are gathered at a time.
_GATHERED = 2048


@dataclass(frozen=True)
class ViewWeights:
    """How much each splat shows in each view, sparse by splats (CSR).

    Attributes:
        offsets: (N + 1,) int64; splat k's entries are ``offsets[k]:offsets[k + 1]``.
        views: (K,) int32 index of the view, any order within a splat, none twice.
        weights: (K,) float32 mean of transmittance times alpha of the splat over the view's pixels, times
            :data:`REFERENCE_PIXELS`; from 0 up.

    Raises:
        UsageError: the arrays do not belong together.
    """

    offsets: NDArray[np.int64]
    views: NDArray[np.int32]
    weights: NDArray[np.float32]

    def __post_init__(self) -> None:
        offsets = self.offsets
        if offsets.ndim != 1 or len(offsets) < 1 or offsets[0] != 0 or (np.diff(offsets) < 0).any():
            raise UsageError("view weights: offsets must start at 0 and never fall")
        if not self.views.shape == self.weights.shape == (int(offsets[-1]),):
            raise UsageError(
                f"view weights: offsets end at {offsets[-1]}, but there are {self.views.shape} views and "
                f"{self.weights.shape} weights"
            )
        if len(self.weights) and not (self.weights.min() >= 0 and self.weights.max() <= _LARGEST_WEIGHT):
            raise UsageError(f"view weights: a weight is negative, above {_LARGEST_WEIGHT:g} or not a number")

    @staticmethod
    def from_importances(
        splats: int, importances: Iterable[tuple[int, NDArray[np.integer[Any]], NDArray[np.floating[Any]]]]
    ) -> ViewWeights:
        """Gather what :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances` gives.

        Args:
            splats: N.
            importances: per view its number, the splats that it sees, ascending, and I_k(s) of each, the mean over the
                view's pixels.
        """
        per_view = [(view, seen.astype(np.uint32), values.astype(np.float32)) for view, seen, values in importances]
        numbers = np.tile(np.array([view for view, _, _ in per_view], np.int32), _GATHERED)
        starts = np.arange(0, splats + _GATHERED, _GATHERED)
        bounds = [np.searchsorted(seen, starts) for _, seen, _ in per_view]
        offsets = np.zeros(splats + 1, np.int64)
        views = np.empty(sum(len(seen) for _, seen, _ in per_view), np.int32)
        weights = np.empty(len(views), np.float32)
        # Some splats at a time, so that what is written here and there stays in the cache.
        for block, start in enumerate(starts[:-1]):
            dense = np.zeros((min(_GATHERED, splats - start), len(per_view)), np.float32)
            for column, ((_, seen, values), bound) in enumerate(zip(per_view, bounds, strict=True)):
                run = slice(bound[block], bound[block + 1])
                dense[seen[run] - start, column] = values[run]
            counts = offsets[start + 1 : start + 1 + len(dense)]
            np.cumsum(np.count_nonzero(dense, axis=1), out=counts)
            counts += offsets[start]
            run = slice(offsets[start], offsets[start + len(dense)])
            present = np.flatnonzero(dense)
            views[run] = numbers[present]
            np.multiply(dense.ravel()[present], np.float32(REFERENCE_PIXELS), out=weights[run])
        return ViewWeights(offsets, views[: offsets[-1]], weights[: offsets[-1]])
