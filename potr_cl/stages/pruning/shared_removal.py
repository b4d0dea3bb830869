"""Removal effects whose views are measured by several: :class:`SharedRemoval` adds up what they find.

All totals are integers, in units that follow from all views (:class:`potr_cl.stages.pruning.fixed_point.FixedPoint`).
So it makes no difference to any bit who measures which view. What is decided is decided in one place, from the sums: by
:mod:`potr_cl.stages.pruning.schedule`, or on the master's device by :mod:`potr_cl.stages.pruning.on_device`.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.opencl.narrow import Narrowing
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.pruning.alive_packing import AlivePacking
from potr_cl.stages.pruning.changed_totals import AddedChanges, numbers_of
from potr_cl.stages.pruning.fixed_point import FixedPoint, zero_totals
from potr_cl.stages.pruning.removal import F64, Indices, RemovalSweep
from potr_cl.stages.pruning.steering import Steered
from potr_cl.stages.pruning.survivors import Bits, Survivors
from potr_cl.workers.parts import Each, Parts, Pending
from potr_cl.workers.pool import Pool

#: Splats a work-group of the kernel that adds totals.
_GROUP = 64


class SharedRemoval(Owner):
    """What :class:`potr_cl.stages.pruning.removal.RemovalSweep` does, with the help of others.

    Args:
        device: the master's.
        splats: N.
        cameras: all views.
        own: measures the master's share of the views; None if it has none.
        others: parts, each a :class:`potr_cl.stages.pruning.part.RemovalPart`, that measure the rest.
        pool: of their workers.
        steers: whether the choice of splats is the master's device's, as with the views on one GPU.
        numbers: of each part's splats, (n,) int64, ascending, where it has no others and knows them by their places;
            None: all parts have all.

    Attributes:
        splats, steering: as of a :class:`~potr_cl.stages.pruning.removal.RemovalSweep`.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(
        self,
        device: Device,
        splats: int,
        cameras: Sequence[Camera],
        own: RemovalSweep | None,
        others: Parts,
        pool: Pool,
        steers: bool,
        numbers: Sequence[Indices] | None = None,
    ) -> None:
        self.splats = splats
        self._own, self._others, self._sparse, self._in_process = own, others, pool.sparse, pool.in_process
        self._numbers = numbers
        assert numbers is None or pool.sparse
        self._device = device
        self._narrowing: Narrowing | None = None
        self._fixed_point = FixedPoint.of_views(cameras)
        self._found: NDArray[np.int64] | None = None
        self._alive = np.ones(splats, bool)
        self.steering: Steered | None = None
        with ExitStack() as owned:
            if steers:
                self.steering = owned.enter_context(_SharedSteering(self, device))
            self._owned = owned.pop_all()

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        # Where the number of splats is given, the host chooses though the device could.
        return self._alive if self.steering is None else self._alive & self.steering.alive

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        pending = self.begin_measuring()
        own = None if self._own is None else self._own.measure_totals()
        totals = self.found_by_others(pending)
        return self._fixed_point.values(totals if own is None else totals + own)

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        pending = self._others.begin("remove", self._places(splats))
        self._alive[splats] = False
        if self._own is not None:
            self._own.remove(splats)
        pending.results()

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        numbers = self._numbers
        # Copies: who does a lost worker's views later is told the same, whatever has become of the caller's array.
        told = sh.copy() if numbers is None else Each([sh[own] for own in numbers])
        pending = self._others.begin("replace_sh", told)
        if self._own is not None:
            self._own.replace_sh(sh)
        pending.results()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """See :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances`."""
        pending = self._others.begin("sweep_changed")
        if self._own is not None:
            self._own.sweep_changed()
        pending.results()
        own = iter(()) if self._own is None else self._own.known_importances()
        others = (self._importances_of(place) for place in range(len(self._others)))
        yield from heapq.merge(own, *others, key=lambda found: found[0])

    def _importances_of(self, part: int) -> Iterator[tuple[int, Indices, F64]]:
        place = 0
        while (found := self._others.ask(part, "importances", place)) is not None:
            number, seen, importances = found
            yield number, seen.astype(np.int64) if self._numbers is None else self._numbers_of(part)[seen], importances
            place += 1

    def _numbers_of(self, part: int) -> Indices:
        assert self._numbers is not None
        return self._numbers[part]

    def _places(self, splats: Indices) -> Indices | Each:
        """What tells the parts about these splats."""
        if self._numbers is None:
            return splats
        meant = np.zeros(self.splats, bool)
        meant[splats] = True
        return Each([np.flatnonzero(meant[own]) for own in self._numbers])

    def tell_marked(self, marked: Bits) -> None:
        """Have the others remove what a device has marked, without waiting for them."""
        told: Bits | Each = marked
        if self._numbers is not None:
            meant = np.unpackbits(marked, count=self.splats, bitorder="little")
            told = Each([np.packbits(meant[own], bitorder="little") for own in self._numbers])
        self._others.begin("remove_marked", told)

    def begin_measuring(self) -> Pending:
        """Have the others measure."""
        return self._others.begin("measure_changes" if self._sparse else "measure")

    def found_by_others(self, pending: Pending) -> NDArray[np.int64]:
        """(N, 2) int64, what they found; valid until the next call."""
        if self._sparse:
            if self._found is None:  # what the others have found; of removed splats anything
                self._found = np.zeros((self.splats, 2), np.int64)
            if self._narrowing is None:
                self._narrowing = self._owned.enter_context(Narrowing(self._device))
            for part, (told, changes) in enumerate(pending.results()):
                splats = numbers_of(told)
                splats = splats if self._numbers is None else self._numbers_of(part)[splats]
                for column, more in enumerate(self._narrowing.widened(changes)):
                    self._found[splats, column] += more
            return self._found
        totals: list[NDArray[np.int64]] = pending.results()
        found = totals[0]
        for more in totals[1:]:
            found += more
        return found

    def close(self) -> None:
        """Give the master's device memory back; the parts are the caller's."""
        self._owned.close()


class _SharedSteering(Owner):
    """A :class:`potr_cl.stages.pruning.steering.Steered` whose totals are the sums over all that measure."""

    def __init__(self, shared: SharedRemoval, device: Device) -> None:
        self._shared = shared
        self.device, self.splats, self.units = device, shared.splats, shared._fixed_point.units
        own = None if shared._own is None else shared._own.steering
        self._own = own
        self._memory, stride = Memory(device), stride_of(shared.splats)
        self._marks: Survivors | None = None
        self._relay = Relay(device) if shared._in_process else None
        self._added: AddedChanges | None = None
        self._numbers: dict[int, tuple[int, cl.Buffer]] = {}
        with device.all_or_nothing():
            self.totals: cl.Buffer = self._memory.upload(zero_totals(stride), "the removal effects")
            self._more = Scratch(device, "the removal effects")
            if own is None:
                self._marks = Survivors(device, self.splats, stride, device.queue.finish)
                self.marks: cl.Buffer = self._marks.buffer
            else:
                self.marks = own.marks
            self._add = device.kernel("prune/add_totals.cl", "add_totals")
            self._alive = None if self._relay is None else AlivePacking(device, self.splats, self.marks)
            if shared._sparse:
                assert own is None, "changes are added to the totals, which therefore are those of the others alone"
                self._added = AddedChanges(device)
                for origin, numbers in enumerate(shared._numbers or ()):
                    buffer = self._memory.upload(numbers.astype(np.uint32), "the splats of workers")
                    self._numbers[origin] = len(numbers), buffer

    @property
    def alive(self) -> NDArray[np.bool_]:
        states: Any = self._marks or self._own
        alive: NDArray[np.bool_] = states.alive
        return alive

    def measure_on_device(self) -> None:
        shared = self._shared
        how = "lend_totals" if self._relay is not None else "changes" if self._added is not None else "measure"
        pending = shared._others.begin(how)
        if self._own is not None:
            self._own.measure_on_device()
        if self._relay is not None:
            self._fetch(pending.results())
        elif self._added is not None:
            for place, changes in enumerate(pending.results()):
                splats, numbers = self._numbers.get(place, (self.splats, None))
                self._added.add(self.totals, changes, splats, numbers)
        else:
            found = shared.found_by_others(pending)
            with self.device.errors("failed while computing"):
                cl.enqueue_copy(self.device.queue, self.totals, found, is_blocking=True)
        if self._own is not None:
            self._add_to_totals(self._own.totals)

    def _fetch(self, found: Sequence[Lent]) -> None:
        """Have as totals the sum of what others lend."""
        assert self._relay is not None
        assert self._alive is not None
        for number, more in enumerate(found):
            packed = self._alive.are_packed(more)
            if number == 0 and not packed:
                self._relay.fetch(self.totals, more)
                continue
            self._more.reserve(more.nbytes)
            self._relay.fetch(self._more.buffer, more)
            if packed:
                self._alive.unpack(self._more.buffer, self.totals, add=number > 0)
            else:
                self._add_to_totals(self._more.buffer)

    def _add_to_totals(self, more: cl.Buffer) -> None:
        self._add.bind(totals=self.totals, more=more, count=2 * self.splats)
        self._add.launch((-(-2 * self.splats // _GROUP) * _GROUP,), (_GROUP,))

    def remove_marked(self) -> None:
        marked = (self._marks or self._own).just_marked()  # type: ignore[union-attr]
        # The others go on with it while the master's device does its own, and whoever tells them more waits for them.
        self._shared.tell_marked(marked)
        if self._own is not None:
            self._own.remove_marked()
        else:
            assert self._marks is not None
            self._marks.marked_by_device()
            self._marks.settle()
        if self._alive is not None:
            self._alive.note()

    def close(self) -> None:
        if self._marks is not None:
            self._marks.close()
        if self._relay is not None:
            self._relay.close()
        if self._alive is not None:
            self._alive.close()
        if self._added is not None:
            self._added.close()
        self._more.close()
        self._memory.close()
