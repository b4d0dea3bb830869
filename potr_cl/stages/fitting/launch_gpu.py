"""The way back from pixels to splats on GPUs: all views of a set in one launch (cl/fit/derivatives_gpu.cl)."""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.macros import gpu_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.fitting.fixed_point import LARGEST_GAP, LARGEST_VALUE

#: Work-items of a tile's work-group.
_GROUP = 128


class GpuLauncher:
    """A :class:`potr_cl.stages.fitting.launcher.Launcher`.

    Args:
        device: to run on.
        rules: of the rasterizer.
    """

    lanes = 1
    most_views = 32

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self._sweep = device.shared_kernel(
            "fit/derivatives_gpu.cl",
            "derivatives",
            ALPHA_CAP=float(rules.alpha_cap),
            TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
            LARGEST_VALUE=LARGEST_VALUE,
            LARGEST_GAP=LARGEST_GAP,
            **gpu_limits(device),
        )

    def sweep(
        self,
        views: ViewSet,
        background: tuple[float, float, float],
        target: cl.Buffer,
        first_pixel: int,
        given: bool,
        unit: float,
        scale: float,
        errors: cl.Buffer,
        totals: cl.Buffer,
    ) -> None:
        """See :meth:`potr_cl.stages.fitting.launcher.Launcher.sweep`."""
        red, green, blue = background
        most = max(view.tiles for view in views.views)
        self._sweep.bind(
            views=views.table,
            stride=views.stride,
            shapes=views.shapes,
            colours=views.colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            red=red,
            green=green,
            blue=blue,
            target=target,
            first_pixel=first_pixel,
            given=given,
            unit=unit,
            scale=scale,
            errors=errors,
            totals=totals,
        ).launch((most * _GROUP, len(views.views)), (_GROUP, 1))
