"""By how much totals have changed, as that travels between computers: :class:`ChangedTotals`, :class:`AddedChanges`.

A bit for each splat says whether its totals have changed, and a row has the changes of those whose bit is set. Of large
scenes the host would take longer to compare than a device takes to measure.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch, Staging
from potr_cl.opencl.narrow import Narrowed, Narrowing

#: (N / 64, rounded up) uint64, a bit for each splat, the lowest first; and (n, 2) int64, the changes of those whose bit
#: is set.
Changes: TypeAlias = "tuple[NDArray[np.uint64], Narrowed | NDArray[np.int64]]"

_SOURCE = "prune/changes.cl"
#: Splats of a run (RUN of the kernels), and work-items of a work-group.
_RUN, _GROUP = 64, 64
#: Bytes of a splat's totals.
_TOTALS = 16
_WHAT = "the removal effects"


class ChangedTotals(Owner):
    """What has changed on a device since it was asked last; at first all totals are 0.

    Args:
        device: that has the totals.
        splats: N.
        states: (N,) uint8 in its memory, :class:`potr_cl.stages.pruning.survivors.SplatState`. Nobody asks for the
            totals of splats that are not alive.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(self, device: Device, splats: int, states: cl.Buffer) -> None:
        self._device, self._splats, self._states = device, splats, states
        self._find, self._take = (device.kernel(_SOURCE, name, NUMBERED=0) for name in ("changed_runs", "take_changes"))
        self._changes = Scratch(device, _WHAT)
        self._masks, self._narrowing = Staging(device), Narrowing(device)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self._runs = _Runs(device, splats)
            self._before = self._memory.allocate(_TOTALS * splats, _WHAT)
            device.fill(self._before, np.uint64(0))

    def take(self, totals: cl.Buffer) -> Changes:
        """The changes in (N, 2) int64 totals; valid until the next call."""
        runs = self._runs
        everywhere = {"totals": totals, "before": self._before, "splats": self._splats, "masks": runs.masks}
        self._find.bind(**everywhere, states=self._states, counts=runs.starts)
        self._find.launch((-(-runs.count // _GROUP) * _GROUP,), (_GROUP,))
        changed = runs.begin()
        masks: NDArray[np.uint64] = self._masks.download(runs.masks, (runs.count,), np.uint64)
        self._changes.reserve(_TOTALS * max(changed, 1))
        self._take.bind(**everywhere, starts=runs.starts, changes=self._changes.buffer)
        self._take.launch((-(-self._splats // _GROUP) * _GROUP,), (_GROUP,))
        return masks, self._narrowing.download(self._changes.buffer, (changed, 2))

    def close(self) -> None:
        """Give the device's memory back."""
        self._runs.close()
        self._changes.close()
        self._masks.close()
        self._narrowing.close()
        self._memory.close()


class AddedChanges(Owner):
    """Adds to the totals on a device what has changed elsewhere.

    Args:
        device: that has the totals.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._add = {numbered: device.kernel(_SOURCE, "add_changes", NUMBERED=int(numbered)) for numbered in (0, 1)}
        self._count = device.kernel(_SOURCE, "count_runs", NUMBERED=0)
        self._runs: dict[int, _Runs] = {}
        self._changes, self._narrowing = Scratch(device, _WHAT), Narrowing(device)

    def add(self, totals: cl.Buffer, changes: Changes, splats: int, numbers: cl.Buffer | None = None) -> None:
        """Add changes to totals.

        Args:
            totals: (N, 2) int64.
            changes: of so many splats as :class:`ChangedTotals` counts them, not more than N.
            splats: how many these are.
            numbers: (splats,) uint32, their numbers among all; None: the same.

        Raises:
            ValueError: the changes are not of so many splats, or their parts do not fit each other.
            DeviceError: the device has no room, or failed.
        """
        masks, found = changes
        changed = found.shape[0]
        if not changed:
            return
        device = self._device
        if splats not in self._runs:
            self._runs[splats] = _Runs(device, splats)
        runs = self._runs[splats]
        if len(masks) != runs.count:
            raise ValueError(f"{len(masks)} words of bits are not those of {splats} splats")
        self._changes.reserve(_TOTALS * changed)
        with device.errors("failed while computing"):
            cl.enqueue_copy(device.queue, runs.masks, masks, is_blocking=True)
            if isinstance(found, Narrowed):
                self._narrowing.upload(self._changes.buffer, found)
            else:
                cl.enqueue_copy(device.queue, self._changes.buffer, found, is_blocking=True)
        self._count.bind(masks=runs.masks, runs=runs.count, counts=runs.starts)
        self._count.launch((-(-runs.count // _GROUP) * _GROUP,), (_GROUP,))
        if runs.begin() != changed:
            raise ValueError(f"{changed} changes do not fit the bits that are set")
        add = self._add[int(numbers is not None)]
        add.bind(
            totals=totals,
            numbers=runs.starts if numbers is None else numbers,
            splats=splats,
            masks=runs.masks,
            starts=runs.starts,
            changes=self._changes.buffer,
        )
        add.launch((-(-splats // _GROUP) * _GROUP,), (_GROUP,))
        device.queue.finish()  # before the next ones are written over these

    def close(self) -> None:
        """Give the device's memory back."""
        for runs in self._runs.values():
            runs.close()
        self._changes.close()
        self._narrowing.close()


class _Runs(Owner):
    """Which splats of each run have changed, and where its changes begin."""

    def __init__(self, device: Device, splats: int) -> None:
        self._device = device
        self.count = -(-splats // _RUN)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self.masks = self._memory.allocate(8 * self.count, _WHAT)
            self.starts = self._memory.allocate(4 * self.count, _WHAT)

    def begin(self) -> int:
        """From how many have changed in each run make where each begins; how many have changed in all."""
        counts = self._device.download(self.starts, (self.count,), np.uint32)
        ends = np.cumsum(counts, dtype=np.uint32)
        with self._device.errors("failed while computing"):
            cl.enqueue_copy(self._device.queue, self.starts, ends - counts, is_blocking=True)
        return int(ends[-1])

    def close(self) -> None:
        self._memory.close()
