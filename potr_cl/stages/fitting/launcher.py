"""How a device sweeps over pixels for derivatives of pictures. :func:`launcher_for` chooses the way once."""

from __future__ import annotations

from typing import Protocol

from potr_cl.opencl.device import Device
from potr_cl.raster.rules import RasterRules
from potr_cl.stages.fitting.launch_cpu import CpuFitLauncher
from potr_cl.stages.fitting.launch_gpu import GpuFitLauncher
from potr_cl.stages.fitting.pixel_sums import PixelSums


class Launcher(Protocol):
    """Goes from pixels back to splats, in one kernel family's way."""

    @property
    def lanes(self) -> int:
        """How many splats a work-item does, in kernels that go over splats."""
        ...

    @property
    def most_views(self) -> int:
        """Views that a launch can do."""
        ...

    def sweep(self, sums: PixelSums) -> None:
        """Enqueue the sums over the pixels of some views.

        Raises:
            DeviceError: the device refused it.
        """
        ...


def launcher_for(device: Device, rules: RasterRules) -> Launcher:
    """The launcher of the kernel family that the device runs.

    Raises:
        DeviceError: the kernels cannot be built.
    """
    return CpuFitLauncher(device, rules) if device.family == "cpu" else GpuFitLauncher(device, rules)
