"""How a device sums the picture's derivatives over the pixels. :func:`launcher_for` chooses the way once."""

from __future__ import annotations

from typing import Protocol

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.fitting.launch_cpu import CpuLauncher
from potr_cl.stages.fitting.launch_gpu import GpuLauncher


class Launcher(Protocol):
    """Goes back from pixels to splats in one kernel family's way."""

    @property
    def lanes(self) -> int:
        """How many splats a work-item does, in kernels that go over splats."""
        ...

    @property
    def most_views(self) -> int:
        """Views that a launch can do."""
        ...

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
        """Enqueue the sums of cl/fit/sums.clh over the pixels of some views.

        Args:
            views: prepared, with their geometry.
            background: R, G, B behind the splats.
            target: (pixels, 3) float32, view after view, and first_pixel: where these views' begin.
            given: whether these are the numbers v that pixels are multiplied by; if not, v is the picture's difference
                to the target, times ``unit``.
            unit: see there.
            scale: the views' fixed point.
            errors: (tiles,) float32, becomes each tile's sum of v².
            totals: (views, stride, 9) int64, the sums are added to them.

        Raises:
            DeviceError: the device refused it.
        """
        ...


def launcher_for(device: Device, rules: RasterRules) -> Launcher:
    """The launcher of the kernel family that the device runs.

    Raises:
        DeviceError: the kernels cannot be built.
    """
    return CpuLauncher(device, rules) if device.family == "cpu" else GpuLauncher(device, rules)
