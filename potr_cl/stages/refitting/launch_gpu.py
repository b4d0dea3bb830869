"""The re-fit's sweep on GPUs: all views of a set in one launch, one work-group a tile (cl/refit/refit_gpu.cl)."""

from __future__ import annotations

from collections.abc import Sequence

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.raster.macros import gpu_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.refitting.fixed_point import LARGEST_VALUE, fixed_point_scale

#: Work-items of a tile's work-group.
_GROUP = 128


class GpuLauncher:
    """A :class:`potr_cl.stages.refitting.launcher.Launcher`.

    Args:
        device: to run on.
        rules: of the rasterizer.
    """

    lanes = 1
    most_views = 32
    gathered = 1

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self._sweeps = [
            device.shared_kernel(
                "refit/refit_gpu.cl",
                "refit_sweep",
                ALPHA_CAP=float(rules.alpha_cap),
                TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
                LARGEST_VALUE=LARGEST_VALUE,
                WEIGHTS=weights,
                **gpu_limits(device),
            )
            for weights in (0, 1)
        ]

    def fixed_point_scales(self, cameras: Sequence[Camera]) -> list[float]:
        """The one with which no view can overflow, whichever a launch does together."""
        scale = fixed_point_scale(max(c.width for c in cameras), max(c.height for c in cameras))
        return [scale] * len(cameras)

    def sweep(
        self,
        views: ViewSet,
        stride: int,
        colours: cl.Buffer,
        background: tuple[float, float, float],
        target: cl.Buffer | None,
        scale: float,
        errors: cl.Buffer,
        totals: cl.Buffer,
        weights: bool,
    ) -> None:
        """See :meth:`potr_cl.stages.refitting.launcher.Launcher.sweep`."""
        red, green, blue = background
        most = max(view.tiles for view in views.views)
        self._sweeps[weights].bind(
            views=views.table,
            stride=stride,
            shapes=views.shapes,
            colours=colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            red=red,
            green=green,
            blue=blue,
            target=colours if target is None else target,
            has_target=target is not None,
            scale=scale,
            errors=errors,
            totals=totals,
        ).launch((most * _GROUP, len(views.views)), (_GROUP, 1))
