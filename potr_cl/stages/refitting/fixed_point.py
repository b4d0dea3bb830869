"""The fixed point of a sweep's sums over a view's pixels: integers, so that the bits are the same on every run."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.raster.view_set import TILE

#: Pixel values beyond this are cut in the kernels (macro LARGEST_VALUE of cl/refit/refit.clh): no sum can overflow.
LARGEST_VALUE = 64.0


def fixed_point_scale(width: int, height: int) -> float:
    """What sums over a view's pixels are multiplied by: the largest power of two with which 62 bits suffice.

    Args:
        width, height: of the view in pixels.
    """
    area = (width + TILE - 1) * (height + TILE - 1)
    return float(2.0 ** np.floor(62 - np.log2(LARGEST_VALUE * area)))


def gathered_scale(cameras: Sequence[Camera], weights: Sequence[float]) -> float:
    """What the sums over all views are multiplied by: the largest power of two with which 62 bits suffice.

    A view adds to a coefficient at most three channels' sums, as no SH basis function is above 1.

    Args:
        cameras: all views.
        weights: what a pixel of each counts.
    """
    areas = [(camera.width + TILE - 1) * (camera.height + TILE - 1) for camera in cameras]
    bound = 3 * LARGEST_VALUE * math.fsum(weight * area for weight, area in zip(weights, areas, strict=True))
    return float(2.0 ** math.floor(62 - math.log2(bound)))
