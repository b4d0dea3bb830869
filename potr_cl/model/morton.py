"""Morton codes: the bits of three coordinates in turn, so that neighbours in space are neighbours in the order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.order import ascending

#: Of each coordinate, in a code of 64 bits.
BITS = 21
#: Centres whose codes are made at a time.
_ROWS = 1 << 14
#: Bits that a table spreads at a time.
_TABLED = 11


def morton_order(means: NDArray[np.float32], run: Run = map) -> NDArray[np.int64]:
    """(N,) the numbers of (N, 3) centres along a Morton curve (:func:`morton_codes`), those of one code by number."""
    return ascending(morton_codes(means, run), run)


def morton_codes(means: NDArray[np.float32], run: Run = map) -> NDArray[np.uint64]:
    """(N,) places of (N, 3) centres along a Morton curve through the cube that holds nearly all of them.

    The cube is the smallest around the second to the last but one hundredth of the centres on each axis, twice as
    large: a far splat must not take all of the curve's levels. What lies outside of it counts as on its faces.

    Args:
        means: finite.
        run: in place of :func:`map`, to work with several threads.
    """
    some = means[:: max(len(means) // 100_000, 1)].astype(np.float64)
    low, high = np.percentile(some, (2, 98), axis=0)
    middle, side = (low + high) / 2, max(2 * float((high - low).max()), 1e-30)
    corner = middle - side / 2
    codes = np.empty(len(means), np.uint64)
    table = spread(np.arange(1 << _TABLED, dtype=np.uint64))

    def place(start: int) -> None:
        rows = slice(start, start + _ROWS)
        within = means[rows] - corner
        within *= (1 << BITS) / side
        cells = np.clip(within, 0, (1 << BITS) - 1, out=within).T.astype(np.int64)
        found = table[cells & (1 << _TABLED) - 1]
        found |= table[cells >> _TABLED] << np.uint64(3 * _TABLED)
        np.bitwise_or(found[0], found[1] << np.uint64(1), out=codes[rows])
        codes[rows] |= found[2] << np.uint64(2)

    list(run(place, range(0, len(means), _ROWS)))
    return codes


def spread(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Move bit i to bit 3 i, for 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x
