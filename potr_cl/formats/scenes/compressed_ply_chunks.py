"""Which splats of a compressed PLY share their bounds: :func:`in_chunks`.

The steps of a chunk's centres are parts of its extent, so splats that are near each other should share one. A k-d tree
makes chunks that are more compact than runs of a space-filling curve, which jumps: errors of centres have 0.55 of the
energy on lego.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree
from potr_cl.formats.scenes.compressed_ply_values import CHUNK, POSITION_BITS
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray

#: Parts of the tree that threads take, at least so many splats each.
_PART = 1 << 15


def in_chunks(means: FloatArray, threads: int = 0) -> NDArray[np.int64]:
    """(N,) the numbers of splats in an order of which each :data:`CHUNK` in sequence lie near each other.

    Those of a chunk follow Morton's curve.

    Args:
        means: (N, 3) float32, finite.
        threads: to work with; the result does not depend on it. 0: one a processor.
    """
    # Viewers draw splats of nearly the same depth in the order of the file, so it should be that of other writers.
    side = max(float(axis.max()) - float(axis.min()) for axis in means.T)
    order = octree.leaf_order(means, max(side * 2.0**-20, 1e-30))
    tree = _Tree(means.take(order, axis=0))
    parts, small = [(0, len(means))], []
    while parts:
        start, end = parts.pop()
        if end - start <= max(_PART, CHUNK):
            small.append((start, end))
        else:
            middle = tree.split(start, end)
            parts += [(start, middle), (middle, end)]
    with thread_pool(threads) as pool:
        list(pool.map(lambda part: tree.split_to_chunks(*part), small))
    return order.take(tree.numbers.astype(np.int64))


class _Tree:
    """Numbers of splats, and their coordinates in the same order."""

    def __init__(self, means: FloatArray) -> None:
        self.numbers = np.arange(len(means), dtype=np.uint64)
        self._axes = [np.ascontiguousarray(column) for column in means.T]

    def split(self, start: int, end: int) -> int:
        """Order a part by the coordinate with the coarsest steps, as far as its two halves go; where they meet."""
        some = slice(start, end)
        steps = [(float(axis[some].max()) - float(axis[some].min())) / 2.0**bits
                 for axis, bits in zip(self._axes, POSITION_BITS, strict=True)]  # fmt: skip
        values = self._axes[int(np.argmax(steps))][some]
        chunks = -(-(end - start) // CHUNK)
        half = chunks // 2 * CHUNK
        # With its number, no coordinate is there twice: which splats are in which half does not depend on the machine.
        order = np.argpartition(_ascending(values) << np.uint64(32) | self.numbers[some], half)
        for each in (self.numbers, *self._axes):
            each[some] = each[some][order]
        return start + half

    def split_to_chunks(self, start: int, end: int) -> None:
        """Split a part until there are chunks, the splats of each in the order that the tree was given."""
        if end - start > CHUNK:
            middle = self.split(start, end)
            self.split_to_chunks(start, middle)
            self.split_to_chunks(middle, end)
        else:
            self.numbers[start:end].sort()


def _ascending(values: FloatArray) -> NDArray[np.uint64]:
    """Integers of 32 bits in the order of floats."""
    bits = np.ascontiguousarray(values + np.float32(0)).view(np.uint32)  # -0.0 is 0.0 then
    flipped = np.where(bits >> np.uint32(31), ~bits, bits | np.uint32(1 << 31))
    return flipped.astype(np.uint64)
