"""Cuts a scene into blocks of neighbours: :func:`blocks_of`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.octree.morton import BITS as _BITS
from potr_cl.codec.octree.morton import spread

#: Scenes of no more splats are one block; others have blocks of so many at most. A block's own header, models and steps
#: are a few kilobytes, and its octree begins anew: next to nothing for a million.
MOST_WHOLE, MOST_A_BLOCK = 1 << 21, 1 << 20
#: Splats whose codes are made at a time.
_ROWS = 1 << 18


def blocks_of(means: NDArray[np.float32], most_a_block: int = MOST_A_BLOCK) -> list[NDArray[np.int64]]:
    """The numbers of the splats of each block, ascending; blocks are ranges of the Morton order of the centres.

    Args:
        means: (N, 3) float32 centres, finite, N >= 1.
        most_a_block: the most splats of a block.

    Returns:
        As few blocks as that allows, of about the same number of splats each.
    """
    n = len(means)
    order = morton_order(means)
    blocks = -(-n // most_a_block)
    ends = [n * (block + 1) // blocks for block in range(blocks)]
    return [np.sort(order[start:end]) for start, end in zip([0, *ends], ends, strict=False)]


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N,) the numbers of (N, 3) centres along a Morton curve through the cube that holds nearly all of them.

    The cube is the smallest around the second to the last but one hundredth of the centres on each axis, twice as
    large: a far splat must not take all of the curve's levels. What lies outside of it counts as on its faces.
    """
    some = means[:: max(len(means) // 100_000, 1)].astype(np.float64)
    low, high = np.percentile(some, (2, 98), axis=0)
    middle, side = (low + high) / 2, max(2 * float((high - low).max()), 1e-30)
    corner = middle - side / 2
    codes = np.empty(len(means), np.uint64)
    for start in range(0, len(means), _ROWS):
        rows = slice(start, start + _ROWS)
        cells = np.clip((means[rows] - corner) * ((1 << _BITS) / side), 0, (1 << _BITS) - 1).astype(np.uint64)
        codes[rows] = spread(cells[:, 0]) | spread(cells[:, 1]) << np.uint64(1) | spread(cells[:, 2]) << np.uint64(2)
    return np.argsort(codes, kind="stable")
