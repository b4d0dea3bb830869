"""Cuts a scene into blocks of neighbours: :func:`blocks_of`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.morton import morton_order

#: Scenes of no more splats are one block; others have blocks of so many at most. A block's own header, models and steps
#: are a few kilobytes, and its octree begins anew: next to nothing for a million.
MOST_WHOLE, MOST_A_BLOCK = 1 << 21, 1 << 20


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
