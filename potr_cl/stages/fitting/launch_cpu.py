"""Sweeps over pixels for derivatives on CPUs: one view at a time, one work-item a tile (cl/fit/*_cpu.cl)."""

from __future__ import annotations

from potr_cl.opencl.device import Device
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import camera_struct
from potr_cl.stages.fitting.pixel_sums import PixelSums, sums_macros


class CpuFitLauncher:
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
            **sums_macros(rules),
            **totals_limits(device),
        )

    def sweep(self, sums: PixelSums) -> None:
        """See :meth:`potr_cl.stages.fitting.launcher.Launcher.sweep`."""
        (view,) = sums.views.views
        self._sweep.bind(view=camera_struct(view.camera), **sums.arguments).launch((sums.views.tiles,), (1,))
