"""Morton codes: the bits of three coordinates in turn, so that neighbours in space are neighbours in the order."""

from __future__ import annotations

from queue import Empty, SimpleQueue

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.order import ascending

#: Of each coordinate, in a code of 64 bits.
BITS = 21
#: Centres whose codes are made at a time: so many that threads seldom wait for the interpreter.
_ROWS = 1 << 16
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

    spare: SimpleQueue[_Room] = SimpleQueue()

    def place(start: int) -> None:
        try:
            room = spare.get_nowait()
        except Empty:
            room = _Room(min(_ROWS, len(means)))
        own = means[start : start + _ROWS]
        count = slice(len(own))
        within, cells = room.within[:, count], room.cells[:, count]
        some = within.view(np.int64)  # when the places are not needed any more
        bits, more = room.bits[:, count], room.more[:, count]
        np.subtract(own.T, corner[:, None], out=within)
        np.multiply(within, (1 << BITS) / side, out=within)
        np.clip(within, 0, (1 << BITS) - 1, out=within)
        cells[:] = within
        np.bitwise_and(cells, (1 << _TABLED) - 1, out=some)
        np.take(table, some, out=bits, mode="clip")
        np.right_shift(cells, _TABLED, out=cells)
        np.take(table, cells, out=more, mode="clip")
        np.left_shift(more, np.uint64(3 * _TABLED), out=more)
        np.bitwise_or(bits, more, out=bits)
        np.left_shift(bits, np.arange(3, dtype=np.uint64)[:, None], out=bits)
        np.bitwise_or.reduce(bits, axis=0, out=codes[start : start + _ROWS])
        spare.put(room)

    list(run(place, range(0, len(means), _ROWS)))
    return codes


class _Room:
    """Memory that a thread finds codes in: new memory takes longer than the work, where many threads ask for it.

    Args:
        rows: centres at a time.

    Attributes:
        within: (3, rows) places in the cube. cells: (3, rows) the same as numbers. bits, more: (3, rows).
    """

    def __init__(self, rows: int) -> None:
        self.within = np.empty((3, rows))
        self.cells = np.empty((3, rows), np.int64)
        self.bits, self.more = np.empty((2, 3, rows), np.uint64)


def spread(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Move bit i to bit 3 i, for 21 bits, in uint64 of any shape."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x
