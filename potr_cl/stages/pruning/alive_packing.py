"""Totals of the splats that are left, as they travel from one device to another: :class:`AlivePacking`."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.opencl.relay import Lent

_SOURCE = "prune/alive.cl"
#: Splats of a run (RUN of the kernels), and work-items of a work-group.
_RUN, _GROUP = 64, 64
#: Bytes of a splat's totals.
_TOTALS = 16


class AlivePacking(Owner):
    """Packs and unpacks; devices that have removed the same splats agree on where each of the others is.

    Args:
        device: that has the totals.
        splats: N.
        states: (N,) uint8 in its memory, :class:`potr_cl.stages.pruning.survivors.SplatState`.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(self, device: Device, splats: int, states: cl.Buffer) -> None:
        self._device, self._splats, self._states = device, splats, states
        self._left = splats
        runs = -(-splats // _RUN)
        self._runs = runs
        self._alive, self._pack, self._unpack = (
            device.kernel(_SOURCE, name) for name in ("alive_runs", "pack_alive", "unpack_alive")
        )
        self._packed = Scratch(device, "the removal effects")
        self._memory = Memory(device)
        with device.all_or_nothing():
            self._masks = self._memory.allocate(8 * runs, "the splats that are left")
            self._starts = self._memory.allocate(4 * runs, "the splats that are left")

    def note(self) -> None:
        """Pack by the states as they are on the device from now on; before the first call all splats are packed."""
        self._alive.bind(states=self._states, splats=self._splats, masks=self._masks, counts=self._starts)
        self._alive.launch((-(-self._runs // _GROUP) * _GROUP,), (_GROUP,))
        counts = self._device.download(self._starts, (self._runs,), np.uint32)
        ends = np.cumsum(counts, dtype=np.uint32)
        self._left = int(ends[-1])
        with self._device.errors("failed while computing"):
            cl.enqueue_copy(self._device.queue, self._starts, ends - counts, is_blocking=True)

    def lend(self, totals: cl.Buffer) -> Lent:
        """What others need of (N, 2) int64 totals, until the next call; all of them where all splats are left."""
        if self._left == self._splats:
            return Lent(self._device, totals, _TOTALS * self._splats)
        self._packed.reserve(_TOTALS * self._left)
        self._launch(self._pack, totals, self._packed.buffer)
        return Lent(self._device, self._packed.buffer, _TOTALS * self._left)

    def unpack(self, packed: cl.Buffer, totals: cl.Buffer, add: bool) -> None:
        """Enqueue: totals = or += what was lent by a device that has removed the same splats, and copied here."""
        self._launch(self._unpack, totals, packed, add=add)

    def are_packed(self, lent: Lent) -> bool:
        """Whether these are not the totals of all splats."""
        return lent.nbytes < _TOTALS * self._splats

    def _launch(self, kernel: Kernel, totals: cl.Buffer, packed: cl.Buffer, **more: bool) -> None:
        kernel.bind(
            totals=totals, splats=self._splats, masks=self._masks, starts=self._starts, packed=packed, **more
        )  # fmt: skip
        kernel.launch((-(-self._splats // _GROUP) * _GROUP,), (_GROUP,))

    def close(self) -> None:
        """Give the device's memory back."""
        self._packed.close()
        self._memory.close()
