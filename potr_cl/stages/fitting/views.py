"""Which views a fit looks at, in which order, and which judge it: :func:`share_out`, :func:`batches`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

#: One view in so many is held out, but no more than the most.
_ONE_IN, _MOST_HELD_OUT = 8, 8


def share_out(given: int, added: int) -> tuple[list[int], list[int]]:
    """Numbers of the views to fit to, and of those that are held out, spread evenly over those that were given.

    Args:
        given: how many views there are at first, and added: between these. A view that was added is never held out.

    Returns:
        Nothing is held out if there are fewer than two given views.
    """
    if given < 2:
        return list(range(given + added)), []
    every = max(min(_ONE_IN, given), -(-given // _MOST_HELD_OUT))
    held_out = set(range(every // 2, given, every))
    return [number for number in range(given + added) if number not in held_out], sorted(held_out)


def batches(numbers: Sequence[int], size: int, seed: int) -> Iterator[list[int]]:
    """Views in batches, for ever: all of them in a random order, then all again in another.

    Args:
        numbers: of the views, at least one.
        size: of a batch; less if there are not so many views.
        seed: of the order.
    """
    rng = np.random.default_rng(seed)
    size = min(size, len(numbers))
    waiting: list[int] = []
    while True:
        while len(waiting) < size:
            waiting += [int(number) for number in rng.permutation(numbers)]
        yield waiting[:size]
        waiting = waiting[size:]
