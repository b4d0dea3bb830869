"""The way back from pixels to splats on CPUs: one view at a time, one work-item a tile (cl/fit/derivatives_cpu.cl)."""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet, camera_struct
from potr_cl.stages.fitting.fixed_point import LARGEST_GAP, LARGEST_VALUE


class CpuLauncher:
    """A :class:`potr_cl.stages.fitting.launcher.Launcher`.

    Args:
        device: to run on.
        rules: of the rasterizer.
    """

    most_views = 1

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self.lanes = device.vector_width
        self._sweep = device.shared_kernel(
            "fit/derivatives_cpu.cl",
            "derivatives",
            LANES=max(device.vector_width, 8),
            ALPHA_CAP=float(rules.alpha_cap),
            TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
            LARGEST_VALUE=LARGEST_VALUE,
            LARGEST_GAP=LARGEST_GAP,
            **totals_limits(device),
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
        (view,) = views.views
        red, green, blue = background
        self._sweep.bind(
            shapes=views.shapes,
            colours=views.colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            view=camera_struct(view.camera),
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
        ).launch((views.tiles,), (1,))
