"""Totals of splats as they are added up (:func:`add_totals`), and as they travel from one device to another:
:class:`AlivePacking` of those that are left, where devices share a process; :class:`ChangedTotals` and
:class:`AddedChanges` by how much they have changed, where not.

A bit for each splat says whether its totals have changed, and a row has the changes of those whose bit is set. Of large
scenes the host would take longer to compare than a device takes to measure.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner, Scratch, Staging
from potr_cl.opencl.narrow import Narrowed, Narrowing
from potr_cl.opencl.relay import Lent

#: (N / 64, rounded up) uint64, a bit for each splat, the lowest first; and (n, 2) int64, the changes of those whose bit
#: is set.
Changes: TypeAlias = "tuple[NDArray[np.uint64], Narrowed | NDArray[np.int64]]"

_SOURCE, _CHANGES_SOURCE = "prune/alive.cl", "prune/changes.cl"
#: Splats of a run (RUN of the kernels), and work-items of a work-group.
_RUN, _GROUP = 64, 64
#: Bytes of a splat's totals.
_TOTALS = 16
_WHAT = "the removal effects"


def add_totals(device: Device, totals: cl.Buffer, more: cl.Buffer, splats: int, how: str = "add_totals") -> None:
    """Enqueue: totals of so many splats += others, or -= with "subtract_totals"."""
    _over(device.shared_kernel("prune/add_totals.cl", how), 2 * splats, totals=totals, more=more, count=2 * splats)


def _over(kernel: Kernel, items: int, **arguments: Any) -> None:
    """Enqueue a kernel with a work-item for each of so many things."""
    kernel.bind(**arguments).launch((-(-items // _GROUP) * _GROUP,), (_GROUP,))


class AlivePacking(Owner):
    """Packs and unpacks; devices that have removed the same splats agree on where each of the others is.

    Args:
        splats: N.
        states: (N,) uint8 in its memory, :class:`potr_cl.stages.pruning.buffers.SplatState`.
    """

    def __init__(self, device: Device, splats: int, states: cl.Buffer) -> None:
        self._device, self._splats, self._states = device, splats, states
        self._left = splats
        self._alive, self._pack, self._unpack = (
            device.kernel(_SOURCE, name) for name in ("alive_runs", "pack_alive", "unpack_alive")
        )
        self._packed, self._runs = Scratch(device, _WHAT), _Runs(device, splats)

    def note(self) -> None:
        """Pack by the states as they are on the device from now on; before the first call all splats are packed."""
        self._left = self._runs.counted(self._alive, states=self._states, splats=self._splats)

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
        places = {"masks": self._runs.masks, "starts": self._runs.starts}
        _over(kernel, self._splats, totals=totals, splats=self._splats, packed=packed, **places, **more)

    def close(self) -> None:
        """Give the device's memory back."""
        self._packed.close()
        self._runs.close()


class ChangedTotals(Owner):
    """What has changed on a device since it was asked last; at first all totals are 0.

    Args:
        splats: N.
        states: (N,) uint8 in its memory, :class:`potr_cl.stages.pruning.buffers.SplatState`. Nobody asks for the
            totals of splats that are not alive.
    """

    def __init__(self, device: Device, splats: int, states: cl.Buffer) -> None:
        self._device, self._splats, self._states = device, splats, states
        self._find, self._take = (
            device.kernel(_CHANGES_SOURCE, name, NUMBERED=0) for name in ("changed_runs", "take_changes")
        )
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
        everywhere = {"totals": totals, "before": self._before, "splats": self._splats}
        changed = runs.counted(self._find, **everywhere, states=self._states)
        masks: NDArray[np.uint64] = self._masks.download(runs.masks, (runs.count,), np.uint64)
        self._changes.reserve(_TOTALS * max(changed, 1))
        changes = self._changes.buffer
        _over(self._take, self._splats, **everywhere, masks=runs.masks, starts=runs.starts, changes=changes)
        return masks, self._narrowing.download(self._changes.buffer, (changed, 2))

    def close(self) -> None:
        """Give the device's memory back."""
        for owner in (self._runs, self._changes, self._masks, self._narrowing, self._memory):
            owner.close()


class AddedChanges(Owner):
    """Adds to the totals on a device what has changed elsewhere."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._add = {
            numbered: device.kernel(_CHANGES_SOURCE, "add_changes", NUMBERED=int(numbered)) for numbered in (0, 1)
        }
        self._count = device.kernel(_CHANGES_SOURCE, "count_runs", NUMBERED=0)
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
        device.copy(runs.masks, masks)
        if isinstance(found, Narrowed):
            self._narrowing.upload(self._changes.buffer, found)
        else:
            device.copy(self._changes.buffer, found)
        if runs.counted(self._count, runs=runs.count) != changed:
            raise ValueError(f"{changed} changes do not fit the bits that are set")
        _over(
            self._add[int(numbers is not None)],
            splats,
            totals=totals,
            numbers=runs.starts if numbers is None else numbers,
            splats=splats,
            masks=runs.masks,
            starts=runs.starts,
            changes=self._changes.buffer,
        )
        device.finish()  # before the next ones are written over these

    def close(self) -> None:
        """Give the device's memory back."""
        for owner in (*self._runs.values(), self._changes, self._narrowing):
            owner.close()


class _Runs(Owner):
    """Which splats of each run have changed, and where its changes begin."""

    def __init__(self, device: Device, splats: int) -> None:
        self._device = device
        self.count = -(-splats // _RUN)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self.masks = self._memory.allocate(8 * self.count, _WHAT)
            self.starts = self._memory.allocate(4 * self.count, _WHAT)

    def counted(self, kernel: Kernel, **arguments: Any) -> int:
        """Have a kernel count in each run, and make where each run's begin of that; how many there are in all."""
        _over(kernel, self.count, masks=self.masks, counts=self.starts, **arguments)
        counts = self._device.download(self.starts, (self.count,), np.uint32)
        ends = np.cumsum(counts, dtype=np.uint32)
        self._device.copy(self.starts, ends - counts)
        return int(ends[-1])
