"""The fixed point of a view's sums over its pixels: integers, so that the bits are the same on every run."""

from __future__ import annotations

import math

from potr_cl.raster.view_set import TILE

#: Pixels' numbers beyond this are cut in the kernels (macros of cl/fit/sums.clh), and so are their products with the
#: difference of a splat's colour to the one behind it: no sum can overflow.
LARGEST_VALUE, LARGEST_GAP = 64.0, 256.0
#: U² + V² of sums.clh is less wherever alpha reaches 1/255.
_LARGEST_SQUARE = 8.1


def fixed_point_scale(width: int, height: int) -> float:
    """What sums over a view's pixels are multiplied by: the largest power of two with which 62 bits suffice.

    Args:
        width, height: of the view in pixels.
    """
    area = (width + TILE - 1) * (height + TILE - 1)
    return 2.0 ** math.floor(62 - math.log2(max(LARGEST_VALUE, LARGEST_GAP * _LARGEST_SQUARE) * area))
