"""The re-fit's sweep on CPUs: one view at a time, one work-item a tile (cl/refit/refit_cpu.cl)."""

from __future__ import annotations

from collections.abc import Sequence

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet, camera_struct
from potr_cl.stages.refitting.fixed_point import LARGEST_VALUE, fixed_point_scale


class CpuLauncher:
    """A :class:`potr_cl.stages.refitting.launcher.Launcher`.

    Args:
        device: to run on.
        rules: of the rasterizer.
    """

    most_views = 1
    #: The coefficients' sums, which take much more than a view's, go through the memory once for so many views.
    gathered = 4

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self.lanes = device.vector_width
        self._sweeps = [
            device.shared_kernel(
                "refit/refit_cpu.cl",
                "refit_sweep",
                LANES=max(device.vector_width, 8),
                ALPHA_CAP=float(rules.alpha_cap),
                TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
                LARGEST_VALUE=LARGEST_VALUE,
                WEIGHTS=weights,
                **totals_limits(device),
            )
            for weights in (0, 1)
        ]

    def fixed_point_scales(self, cameras: Sequence[Camera]) -> list[float]:
        """Each view's own."""
        return [fixed_point_scale(camera.width, camera.height) for camera in cameras]

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
        (view,) = views.views
        red, green, blue = background
        self._sweeps[weights].bind(
            shapes=views.shapes,
            colours=colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            view=camera_struct(view.camera),
            red=red,
            green=green,
            blue=blue,
            target=colours if target is None else target,
            has_target=target is not None,
            scale=scale,
            errors=errors,
            totals=totals,
        ).launch((views.tiles,), (1,))
