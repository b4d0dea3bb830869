"""How each kernel family finds nearest centres: both have the same kernel, in different blocks of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel

#: Work-items of a GPU's work-group, a point each.
_GROUP = 128


@dataclass(frozen=True)
class NearestLauncher:
    """Runs the kernel "nearest" in one family's way.

    Attributes:
        block: points that are compared with the same centres.
        group: work-items of a work-group, and for a block.
    """

    kernel: Kernel
    block: int
    group: int

    def enqueue(self, blocks: int, **arguments: Any) -> None:
        """Enqueue it for so many blocks, with the arguments that cl/clustering/nearest_*.cl declare."""
        self.kernel.bind(**arguments).launch((blocks * self.group,), (self.group,))


def launcher_for(device: Device, width: int) -> NearestLauncher:
    """The launcher of the device's kernel family, for rows of so many floats.

    Raises:
        DeviceError: the kernels cannot be built.
    """
    if device.family == "gpu":
        kernel = device.shared_kernel("clustering/nearest_gpu.cl", "nearest", WIDTH=width, GROUP=_GROUP)
        return NearestLauncher(kernel, _GROUP, _GROUP)
    lanes = device.vector_width
    kernel = device.shared_kernel("clustering/nearest_cpu.cl", "nearest", WIDTH=width, LANES=lanes)
    return NearestLauncher(kernel, lanes, 1)
