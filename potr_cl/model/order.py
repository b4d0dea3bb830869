"""Numbers in order: :func:`ascending`, for which :func:`over_ranges` shares many out. Pure NumPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run

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
