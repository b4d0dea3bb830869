"""Marks and totals as the kernels of some views number splats: :class:`Ledger`."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.macros import totals_limits
from potr_cl.stages.pruning.fixed_point import zero_totals
from potr_cl.stages.pruning.survivors import SplatState, Survivors
from potr_cl.views.subsets import Subset

_SOURCE, _GROUP = "prune/parts.cl", 64


class Ledger(Owner):
    """The scene's own marks and totals, or, for CPU kernels of some of the splats, some that are numbered as these.

    GPU kernels are told the splats' numbers in the scene; CPU kernels know places only.

    Args:
        survivors: the scene's marks.
        totals: (N, 2) int64 that the kernels add to, by the splats' numbers.
        subset: the splats of the views.

    Attributes:
        marks, totals, numbers: for the kernels; no numbers: they know places only.
        is_local: whether :meth:`add_to` has anything to do.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(self, survivors: Survivors, totals: cl.Buffer, subset: Subset) -> None:
        self._survivors, self._device, self._count = survivors, survivors.device, subset.count
        self._own_numbers = subset.numbers
        self._memory = Memory(self._device)
        self.is_local = subset.numbers is not None and self._device.family == "cpu"
        self.marks, self.totals, self.numbers = survivors.buffer, totals, subset.numbers
        if self.is_local:
            stride = subset.rasterizer.stride
            with self._device.all_or_nothing():
                alive = np.full(stride, SplatState.ALIVE, np.uint8)
                self.marks = self._memory.upload(alive, "the splats that are left")
                self.totals = self._memory.upload(zero_totals(stride), "the removal effects")
            self.numbers = None

    def take_marks(self) -> None:
        """Enqueue that the marks are those of the scene."""
        if self.is_local:
            self._launch("mark_part", states=self._survivors.buffer, part=self.marks)

    def add_to(self, totals: cl.Buffer) -> None:
        """Enqueue that what the kernels have added is added to the scene's totals, (N, 2) int64."""
        if self.is_local:
            self._launch("add_part", totals=totals, part=self.totals)

    def _launch(self, name: str, **given: cl.Buffer) -> None:
        kernel = shared_kernel(self._device, name)
        kernel.bind(**given, numbers=self._own_numbers, count=self._count)
        kernel.launch((-(-self._count // _GROUP) * _GROUP,), (_GROUP,))

    def close(self) -> None:
        self._memory.close()


def shared_kernel(device: Device, name: str) -> Kernel:
    """A kernel of cl/prune/parts.cl."""
    return device.shared_kernel(_SOURCE, name, **totals_limits(device))
