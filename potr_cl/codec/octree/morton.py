"""Morton codes: the bits of three coordinates in turn."""

from __future__ import annotations

import numpy as np

from potr_cl.codec.octree.streams import U64

#: Of each coordinate, in a code of 64 bits.
BITS = 21


def spread(x: U64) -> U64:
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
