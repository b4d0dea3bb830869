"""Sweeps over pixels for derivatives on GPUs: all views of a set in one launch (cl/fit/*_gpu.cl)."""

from __future__ import annotations

from potr_cl.opencl.device import Device
from potr_cl.raster.macros import gpu_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.stages.fitting.pixel_sums import PixelSums, sums_macros

#: Work-items of a tile's work-group.
_GROUP = 128


class GpuFitLauncher:
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
            **sums_macros(rules),
            **gpu_limits(device),
        )

    def sweep(self, sums: PixelSums) -> None:
        """See :meth:`potr_cl.stages.fitting.launcher.Launcher.sweep`."""
        views = sums.views
        # A work-group for each tile of the largest view, in every view: those beyond a view's tiles do nothing.
        most = max(view.tiles for view in views.views)
        self._sweep.bind(views=views.table, stride=views.stride, **sums.arguments)
        self._sweep.launch((most * _GROUP, len(views.views)), (_GROUP, 1))
