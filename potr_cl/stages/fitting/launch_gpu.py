"""Sweeps over pixels for derivatives on GPUs: all views of a set in one launch (cl/fit/*_gpu.cl)."""

from __future__ import annotations

from typing import Any

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.macros import gpu_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.fitting.pixel_sums import PixelSums, PixelTangents, pixel_macros, sums_macros

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
            **sums_macros(rules),
            **gpu_limits(device),
        )
        self._device, self._rules = device, rules

    def sweep(self, sums: PixelSums) -> None:
        """See :meth:`potr_cl.stages.fitting.launcher.Launcher.sweep`."""
        _launch(self._sweep, sums.views, sums.arguments)

    def tangents(self, tangents: PixelTangents) -> None:
        """See :meth:`potr_cl.stages.fitting.launcher.Launcher.tangents`."""
        kernel = self._device.shared_kernel(
            "fit/tangents_gpu.cl",
            "tangents",
            NATIVE_EXP2=int(self._device.native_exp2),
            **pixel_macros(self._rules),
        )
        _launch(kernel, tangents.views, tangents.arguments)


def _launch(kernel: Kernel, views: ViewSet, arguments: dict[str, Any]) -> None:
    """A work-group for each tile of the largest view, in every view: those beyond a view's tiles do nothing."""
    most = max(view.tiles for view in views.views)
    kernel.bind(views=views.table, stride=views.stride, **arguments)
    kernel.launch((most * _GROUP, len(views.views)), (_GROUP, 1))
