"""Cuts a scene into blocks of neighbours: :func:`blocks_of`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.order import BITS, morton_codes

#: Scenes of no more splats are one block; others have blocks of so many at most. A block's own header, models and steps
#: are a few kilobytes, and its octree begins anew: next to nothing for a million.
MOST_WHOLE, MOST_A_BLOCK = 1 << 21, 1 << 20


#: Of a Morton code of 63 bits, those by which most splats are told apart.
_FIRST_BITS = 16


def blocks_of(means: NDArray[np.float32], most_a_block: int = MOST_A_BLOCK, run: Run = map) -> list[NDArray[np.int64]]:
    """The numbers of the splats of each block, ascending; blocks are ranges of the Morton order of the centres.

    Args:
        means: (N, 3) float32 centres, finite, N >= 1.
        most_a_block: the most splats of a block.
        run: in place of :func:`map`, to work with several threads.

    Returns:
        As few blocks as that allows, of about the same number of splats each.
    """
    n = len(means)
    codes = morton_codes(means, run)
    blocks = -(-n // most_a_block)
    ends = np.array([n * (block + 1) // blocks for block in range(blocks)])
    # Only where a block ends within those whose first bits are the same is their order needed.
    cells = (codes >> np.uint64(3 * BITS - _FIRST_BITS)).astype(np.uint16)
    behind = np.cumsum(np.bincount(cells, minlength=1 << _FIRST_BITS))
    before = np.concatenate([[0], behind[:-1]])
    blocks_of_cells = np.searchsorted(ends, before, side="right")
    block_of = blocks_of_cells.astype(np.int32)[cells]
    for cell in np.flatnonzero((np.searchsorted(ends, behind - 1, side="right") > blocks_of_cells) & (behind > before)):
        members = np.flatnonzero(cells == cell)
        members = members[np.argsort(codes[members], kind="stable")]
        block_of[members] = np.searchsorted(ends, before[cell] + np.arange(len(members)), side="right")
    return list(run(lambda block: np.flatnonzero(block_of == block), range(blocks)))
