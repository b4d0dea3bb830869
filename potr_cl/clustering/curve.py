"""Points in an order in which neighbours are near each other, :func:`along_curve`: Hilbert's curve through space.

After J. Skilling, "Programming the Hilbert curve", AIP Conference Proceedings 707, 2004.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool

#: Bits of a coordinate: three of them fit a 64-bit number.
_BITS = 16
#: Points that a thread works on at a time: their temporaries stay in the cache.
_BLOCK = 1 << 14


def along_curve(coordinates: NDArray[np.uint16]) -> NDArray[np.int64]:
    """The numbers of points as the curve comes by them; those of equal coordinates keep their order.

    Args:
        coordinates: (N, 3) uint16.
    """
    places = np.empty(len(coordinates), np.uint64)

    def find(start: int) -> None:
        some = slice(start, start + _BLOCK)
        places[some] = _places(coordinates[some])

    with thread_pool() as pool:
        list(pool.map(find, range(0, len(places), _BLOCK)))
    return np.argsort(places, kind="stable")


def _places(coordinates: NDArray[np.uint16]) -> NDArray[np.uint64]:
    """(n,) how far along the curve points are."""
    axes = [np.ascontiguousarray(axis, np.uint16) for axis in coordinates.T.copy()]
    # From Cartesian coordinates to those of the curve, a cube after the other, the largest first.
    for bit in range(_BITS - 1, 0, -1):
        below = np.uint16((1 << bit) - 1)
        for number in range(3):
            inside = axes[number] >> np.uint16(bit) & np.uint16(1)
            turned = np.where(inside, np.uint16(0), (axes[0] ^ axes[number]) & below)
            axes[0] ^= np.where(inside, below, turned)
            if number:
                axes[number] ^= turned
    # Gray code.
    axes[1] ^= axes[0]
    axes[2] ^= axes[1]
    carried = np.zeros_like(axes[2])
    for bit in range(_BITS - 1, 0, -1):
        carried ^= np.where(axes[2] >> np.uint16(bit) & np.uint16(1), np.uint16((1 << bit) - 1), np.uint16(0))
    places = np.zeros(len(coordinates), np.uint64)
    turned_axes = [(axis ^ carried).astype(np.uint64) for axis in axes]
    for bit in range(_BITS - 1, -1, -1):
        for axis in turned_axes:
            places = places << np.uint64(1) | axis >> np.uint64(bit) & np.uint64(1)
    return places
