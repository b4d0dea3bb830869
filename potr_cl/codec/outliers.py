"""Splats so far from the others that the octree has no levels left for these: :func:`check_positions`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree
from potr_cl.errors import DataError

#: An octree that is no deeper has cells fine enough for its tolerances, and float64 tells them apart.
_SAFE_DEPTH = 44
#: An error that is smaller than this part of a splat, or of half the scene's typical extent, is none.
_PART_OF_A_SPLAT, _PART_OF_THE_SCENE = 2.0**-20, 2.0**-32
#: Splats that a message names.
_NAMED = 3


def may_be_coarse(depth: int) -> bool:
    """Whether there is something to check for :func:`check_positions` in an octree of so many levels."""
    return depth > _SAFE_DEPTH


def check_positions(
    centres: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    tolerance: NDArray[np.float64],
    tree: octree.OctreeStreams,
    order: NDArray[np.int64],
) -> None:
    """Refuse a scene where a far splat would make the positions of others coarser than they are without it.

    Args:
        centres: (N, 3) as they were given to the octree.
        log_scales: (N, 3) of the splats.
        tolerance: (N,) allowed distances of centres, world units.
        tree, order: what :func:`potr_cl.codec.octree.build` made of them.

    Raises:
        DataError: there is such a splat.
    """
    means = centres.astype(np.float64)
    resolution = np.abs(means).max(axis=1) * 2.0**-23
    sizes = np.exp(np.clip(log_scales.max(axis=1).astype(np.float64), -60, 60))
    distance = np.abs(means - np.median(means, axis=0)).max(axis=1)
    harmless = np.maximum(sizes * _PART_OF_A_SPLAT, float(np.median(distance)) * _PART_OF_THE_SCENE)
    allowed = np.maximum(np.maximum(tolerance, resolution), harmless)
    decoded = np.empty_like(means)
    decoded[order] = octree.parse(tree, len(centres))
    decoded -= means
    # Single precision rounds once more.
    if (np.sqrt(np.einsum("ij,ij->i", decoded, decoded)) <= allowed + resolution).all():
        return
    far = centres[_far(means, distance, allowed)]
    named = ", ".join(f"({x:.4g}, {y:.4g}, {z:.4g})" for x, y, z in far[:_NAMED])
    what = f"the splat at {named} is" if len(far) == 1 else f"{len(far)} splats, such as those at {named}, are"
    raise DataError(
        f"{what} so far from the others that the others would lose their exact positions: remove what is out there, "
        "or let pruning do it (it needs views that show nothing of it)"
    )


def _far(means: NDArray[np.float64], distance: NDArray[np.float64], allowed: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the fewest splats, those at the largest distance, without which the deepest level would do."""
    nearest_first = np.argsort(distance, kind="stable")
    sorted_means = means[nearest_first]
    extent = np.maximum.accumulate(sorted_means) - np.minimum.accumulate(sorted_means)
    # Twice the half diagonal of a cell: float64 rounds by as much at the deepest level.
    error = extent.max(axis=1) * np.sqrt(3) * 2.0**-octree.DEEPEST_LEVEL
    fits = np.flatnonzero(error <= np.minimum.accumulate(allowed[nearest_first]))
    kept = min(int(fits[-1]) + 1 if len(fits) else 0, len(means) - 1)
    return nearest_first[kept:]
