"""How close one scene comes to another: :func:`psnr`, :func:`mean_error`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.quality import metrics
from potr_cl.raster.rasterizer import Rasterizer


def psnr(device: Device, scene: Scene, other: Scene, views: Sequence[Camera]) -> float:
    """Mean PSNR of a scene's pictures against those of another one, decibels; without those that are identical."""
    with Rasterizer(device, scene) as a, Rasterizer(device, other) as b:
        all_views = [metrics.psnr(b.render(view)[0], a.render(view)[0]) for view in views]
    finite = [each for each in all_views if math.isfinite(each)]
    return float(np.mean(finite)) if finite else math.inf


def mean_error(device: Device, scene: Scene, other: Scene, views: Sequence[Camera]) -> float:
    """Mean squared difference of two scenes' pictures."""
    with Rasterizer(device, scene) as a, Rasterizer(device, other) as b:
        return float(np.mean([np.mean((a.render(view)[0] - b.render(view)[0]) ** 2) for view in views]))
