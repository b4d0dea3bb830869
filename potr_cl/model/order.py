"""Numbers in order (:func:`ascending`), and centres along a Morton curve, on which neighbours in space are neighbours
(:func:`morton_order`). Pure NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run, Spare

#: So many numbers are put into ranges first, which threads sort; numbers of a range, on the average, and how many
#: ranges there are at most (their numbers take a byte).
_LARGE, _RANGE, _MOST_RANGES = 1 << 19, 1 << 16, 256
#: Numbers that are put into ranges at a time, at most and at least; into how many pieces, so that many threads have
#: one; and how many numbers of each range are looked at to find where it ends.
_DEALT, _LEAST_DEALT, _PIECES, _SAMPLED = 1 << 19, 1 << 15, 32, 64


def ascending(score: NDArray[Any], run: Run = map) -> NDArray[np.int64]:
    """Stable argsort: by score, ties by number.

    Args:
        score: (N,), no NaN.
        run: shares the work on many out.
    """

    def finish(members: NDArray[np.int64], place: int) -> None:
        members[:] = members[_sorted(score[members])]

    return _sorted(score) if len(score) < _LARGE else over_ranges(score, finish, run)


def least(score: NDArray[Any], count: int) -> NDArray[np.bool_]:
    """(N,) which are the ``count`` least scores, of equal ones the first: those that :func:`ascending` begins with.

    Args:
        score: (N,), no NaN.
        count: from 0 to N.
    """
    if count == 0:
        return np.zeros(len(score), bool)
    last = np.partition(score, count - 1)[count - 1]
    found: NDArray[np.bool_] = score < last
    found[np.flatnonzero(score == last)[: count - np.count_nonzero(found)]] = True
    return found


def _sorted(score: NDArray[Any]) -> NDArray[np.int64]:
    """The unstable sort is ten times as fast, and ties are few."""
    order = np.argsort(score)
    ordered = score[order]
    same = ordered[1:] == ordered[:-1]
    if same.any():
        tied = np.zeros(len(order), bool)
        tied[1:] = same
        tied[:-1] |= same
        members = order[tied]
        order[tied] = members[np.lexsort((members, score[members]))]
    return order


def are_many(numbers: int) -> bool:
    """Whether :func:`over_ranges` is worth its own time for so many numbers."""
    return numbers >= _LARGE


def over_ranges(
    score: NDArray[Any], work: Callable[[NDArray[np.int64], int], None], run: Run = map
) -> NDArray[np.int64]:
    """Deal out numbers to ranges of scores, as they stand, and have each range worked on by itself.

    Args:
        score: (N,), no NaN; equal scores are in one range.
        work: called with the numbers of a range, (n,) ascending, to be put into order in place, and with how many there
            are in all ranges before it.
        run: shares the ranges out.

    Returns:
        (N,) the numbers of all ranges one after another.
    """
    ranges = min(max(len(score) // _RANGE, 1), _MOST_RANGES)
    few = np.sort(score[:: max(len(score) // (ranges * _SAMPLED), 1)])
    # The first score of each range but the first one: equal ones are in the same range.
    ends = few[np.arange(1, ranges) * len(few) // ranges]
    size = min(max(-(-len(score) // _PIECES), _LEAST_DEALT), _DEALT)
    starts = range(0, len(score), size)

    def deal(first: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        own = np.searchsorted(ends, score[first : first + size], "right").astype(np.uint8)
        return np.argsort(own, kind="stable"), np.bincount(own, minlength=ranges)

    dealt = list(run(deal, starts))
    counts = np.stack([count for _, count in dealt])
    begins = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    places = begins[:-1] + np.cumsum(counts, axis=0) - counts
    numbers = np.empty(len(score), np.int64)

    def gather(piece: int) -> None:
        order, count = dealt[piece]
        stops = np.cumsum(count)
        for place, start, stop in zip(places[piece].tolist(), (stops - count).tolist(), stops.tolist(), strict=True):
            np.add(order[start:stop], starts[piece], out=numbers[place : place + stop - start])

    list(run(gather, range(len(dealt))))
    dealt.clear()

    def finish(number: int) -> None:
        work(numbers[begins[number] : begins[number + 1]], int(begins[number]))

    list(run(finish, range(ranges)))
    return numbers


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

    spare = Spare(lambda: _Room(min(_ROWS, len(means))))

    def place(start: int) -> None:
        own = means[start : start + _ROWS]
        count = slice(len(own))
        with spare.taken() as room:
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
