"""Points in an order in which neighbours are near each other, :func:`along_curve`: Hilbert's curve through space.

Within each octant of a cube the curve runs as it does through the whole cube, but turned and mirrored. So tables tell
from the octants that a point is in, the largest first, how far along the curve it is.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.order import ascending, spread

#: Bits of a coordinate, and how many of them are looked up at a time.
_BITS, _TABLED = 16, 4
#: Points that a thread works on at a time.
_BLOCK = 1 << 16
#: What octants, numbers of three bits, become where the curve is turned and mirrored.
_Turn: TypeAlias = tuple[int, ...]
#: The octants as the curve comes by them, and how it is turned within each, by their number.
_WAY = (0, 1, 3, 2, 6, 7, 5, 4)
_TURNS: tuple[_Turn, ...] = (
    (0, 4, 1, 5, 2, 6, 3, 7),
    (0, 1, 4, 5, 2, 3, 6, 7),
    (5, 1, 7, 3, 4, 0, 6, 2),
    (0, 1, 2, 3, 4, 5, 6, 7),
    (6, 2, 7, 3, 4, 0, 5, 1),
    (6, 7, 2, 3, 4, 5, 0, 1),
    (0, 4, 2, 6, 1, 5, 3, 7),
    (0, 1, 2, 3, 4, 5, 6, 7),
)


def along_curve(coordinates: NDArray[np.uint16]) -> NDArray[np.int64]:
    """The numbers of points as the curve comes by them; those of equal coordinates keep their order.

    Args:
        coordinates: (N, 3) uint16.
    """
    places = np.empty(len(coordinates), np.uint64)
    octants_of = spread(np.arange(1 << _BITS, dtype=np.uint64))
    places_of, states_after = _tables()

    def find(start: int) -> None:
        octants = octants_of[coordinates[start : start + _BLOCK]]
        octants <<= np.array([2, 1, 0], np.uint64)
        within = np.bitwise_or.reduce(octants, axis=1)
        state, found = np.zeros(len(within), np.intp), places[start : start + _BLOCK]
        found[:] = 0
        for bit in range(_BITS - _TABLED, -1, -_TABLED):
            cell = (within >> np.uint64(3 * bit) & np.uint64(places_of.shape[1] - 1)).astype(np.intp)
            cell += state * places_of.shape[1]
            found <<= np.uint64(3 * _TABLED)
            found |= places_of.take(cell)
            state = states_after.take(cell)

    with thread_pool() as pool:
        list(pool.map(find, range(0, len(places), _BLOCK)))
        return ascending(places, pool.map)


@lru_cache(maxsize=1)
def _tables() -> tuple[NDArray[np.uint64], NDArray[np.intp]]:
    """Where along the curve a cell is, and the state within it, by the state outside and the cell's octants.

    Both (states, 8 ** :data:`_TABLED`); a state is how the curve is turned, and 0 that of the whole.
    """
    states: list[_Turn] = [tuple(range(8))]
    after: list[list[int]] = []
    for turn in states:  # which grows meanwhile
        after.append([])
        for octant in range(8):
            then = tuple(_TURNS[turn[octant]][each] for each in turn)
            if then not in states:
                states.append(then)
            after[-1].append(states.index(then))
    digit = np.argsort(_WAY)[np.array(states)].astype(np.uint64)
    places, state = np.zeros((len(states), 1), np.uint64), np.arange(len(states))[:, None]
    for _ in range(_TABLED):
        places = (places[:, :, None] << np.uint64(3) | digit[state]).reshape(len(states), -1)
        state = np.array(after)[state].reshape(len(states), -1)
    return places, state
