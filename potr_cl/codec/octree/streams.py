"""What an octree is stored as: :class:`OctreeStreams`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError

#: Levels that float64 arithmetic on the root cube can tell apart.
DEEPEST_LEVEL = 52

_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)

U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]


@dataclass(frozen=True)
class OctreeStreams:
    """A serialised octree.

    Attributes:
        origin: corner of the root cube with the smallest coordinates, world units.
        side: edge of the root cube, world units; 0 if all centres coincide.
        depth: deepest level of any leaf, 0 to 52.
        occupancy: uint8, one a node that holds several splats and lies above ``depth``, breadth first; bit
            ``x + 2 y + 4 z`` is set if the child octant at (x, y, z) holds a splat.
        several: uint8, bits packed with the first in the lowest bit: one a child in the order of ``occupancy``, set if
            the child holds several splats.
        multiplicities: uint64, number of splats of each leaf at ``depth`` that holds several, in Morton order.
        leaf_levels: uint8, one a leaf with a single splat, in Morton order: the level that its tail leads to; there is
            no tail where the splat is still in company at that level.
        tails: uint8, bit planes: for level 1, 2, … of the tails and axis x, y, z one plane, padded to whole bytes
            (first bit lowest), of the leaves whose tail reaches that level, longest tail first, then Morton order.
    """

    origin: tuple[float, float, float]
    side: float
    depth: int
    occupancy: U8
    several: U8
    multiplicities: U64
    leaf_levels: U8
    tails: U8


def check_centres(origin: tuple[float, float, float], side: float, means: NDArray[np.float32]) -> None:
    """Refuse centres, (N, 3), that single precision cannot hold.

    Args:
        origin, side: as of :class:`OctreeStreams`.
        means: the centres.

    Raises:
        DataError: there is one.
    """
    if max(map(abs, origin)) + side > _LARGEST_FLOAT32 and not np.isfinite(means).all():
        raise DataError("positions: a centre is beyond what single precision can hold")
