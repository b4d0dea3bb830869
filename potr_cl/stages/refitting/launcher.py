"""How a device runs the re-fit's sweep over the tiles of prepared views. :func:`launcher_for` chooses the way once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.refitting.launch_cpu import CpuLauncher
from potr_cl.stages.refitting.launch_gpu import GpuLauncher


class Launcher(Protocol):
    """Runs sweeps in one kernel family's way."""

    @property
    def lanes(self) -> int:
        """How many splats a work-item does, in kernels that go over splats."""
        ...

    @property
    def most_views(self) -> int:
        """Views that a launch can do."""
        ...

    @property
    def gathered(self) -> int:
        """Launches whose sums are gathered together, where each does one view."""
        ...

    def fixed_point_scales(self, cameras: Sequence[Camera]) -> list[float]:
        """What the sums of each view are multiplied by, see :func:`.fixed_point.fixed_point_scale`.

        Args:
            cameras: all views; those that a launch does have one scale.
        """
        ...

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
        """Enqueue a sweep: from the splats' colours to the pixels' values, and from those to sums for each splat.

        Args:
            views: prepared, with their geometry.
            stride: splats of a view, padding included.
            colours: (views, stride, 4) float32, R, G, B of each splat in each view.
            background: R, G, B behind the splats.
            target: (pixels, 3) float32, view after view: subtracted from the pixels; None: nothing is.
            scale: the views' fixed point.
            errors: (tiles,) float32, becomes each tile's sum of squared pixel values.
            totals: (views, stride, 4) int64: weight times value, three channels, and the squared weights are added.
            weights: sum up the squared weights too.

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
