"""How each kernel family runs the compaction: both have the same kernel, in different work-groups and vectors."""

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


def launch_shape(device: Device) -> LaunchShape:
    """The shape for a device's kernel family."""
    if device.family == "gpu":
        return LaunchShape(lanes=1, block=4, group=64, pinned=True)
    # Work-groups of one work-item: these kernels keep kilobytes of private memory each.
    return LaunchShape(lanes=device.vector_width, block=8, group=1, pinned=False)
