"""How the kernel families run the compaction: the kernel is the same, its shape is not."""

from __future__ import annotations

from dataclasses import dataclass

from potr_cl.opencl.device import Device


@dataclass(frozen=True)
class LaunchShape:
    """How a kernel family runs the compaction.

    Attributes:
        lanes: splats that a work-item takes.
        block: rows of the basis matrix that are reduced at a time.
        group: work-items of a work-group.
        pinned: whether data go to the device by way of pinned memory.
    """

    lanes: int
    block: int
    group: int
    pinned: bool


def launch_shape(device: Device, double: bool) -> LaunchShape:
    """The shape for a device's kernel family.

    Args:
        double: whether it computes in double precision, of which CPUs take half as many at a time.
    """
    if device.family == "gpu":
        return LaunchShape(lanes=1, block=4, group=64, pinned=True)
    lanes = device.vector_width
    if double and lanes > 1:
        lanes = max(lanes // 2, 4)
    # Work-groups of one work-item: these kernels keep kilobytes of private memory each.
    return LaunchShape(lanes=lanes, block=8, group=1, pinned=False)
