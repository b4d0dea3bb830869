"""Removal effects whose views are measured by several: :class:`RemovalPart` does some of them on a worker, and
:class:`SharedRemoval` adds up what all find.

All totals are integers, in units that follow from all views (:class:`potr_cl.stages.pruning.fixed_point.FixedPoint`).
So it makes no difference to any bit who measures which view. The master's device adds up: what other devices of this
process lend, or what has changed elsewhere since it was last told (:mod:`~potr_cl.stages.pruning.travelling_totals`).
What is decided is decided in one place, from the sums: by :mod:`potr_cl.stages.pruning.schedule`, or on the master's
device by :mod:`potr_cl.stages.pruning.on_device`.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch, Staging
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.raster.carried import Excerpt
from potr_cl.raster.kept_scene import KeptScene, PartOfKept, lying_on, whole_on_device
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.pruning.fixed_point import FixedPoint, zero_totals
from potr_cl.stages.pruning.removal import F64, Indices, RemovalSweep, planned_sweep
from potr_cl.stages.pruning.staleness import SweepOptions
from potr_cl.stages.pruning.survivors import Bits, Survivors
from potr_cl.stages.pruning.travelling_totals import AddedChanges, AlivePacking, ChangedTotals, Changes
from potr_cl.views.visibility import Visibility
from potr_cl.workers.parts import Each, Parts
from potr_cl.workers.pool import Part, Pool


class RemovalPart(Part):
    """Some of the views; see :class:`potr_cl.stages.pruning.removal.RemovalSweep`.

    Args:
        device: to compute on.
        memory: bytes of its memory that the views may take; None: the default.
        scene: the uncompressed scene, perhaps kept on devices; or of it what these views may draw
            (:mod:`potr_cl.views.shares`).
        cameras: all views.
        options: speed/accuracy trade-offs.
        background: R, G, B behind the scene.
        numbers: of the views of this part, ascending.
        sights: what all views see of it, where each had better be looked at with what it sees; None: with all splats.

    Raises:
        DeviceError: the scene or a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        memory: int | None,
        scene: Scene | KeptScene | PartOfKept | Excerpt,
        cameras: Sequence[Camera],
        options: SweepOptions,
        background: tuple[float, float, float],
        numbers: Sequence[int],
        sights: Visibility | None = None,
    ) -> None:
        options = SweepOptions(**{**vars(options), "memory": memory})
        with ExitStack() as owned:
            drawable = owned.enter_context(lying_on(device, scene))
            if sights is not None:
                drawable = owned.enter_context(whole_on_device(device, drawable))
            sweep = planned_sweep(device, drawable, cameras, options, background, sights, numbers)
            self._sweep = owned.enter_context(sweep)
            self._alive = owned.enter_context(AlivePacking(device, self._sweep.splats, self._sweep.marks))
            self._changed: ChangedTotals | None = None
            self._owned = owned.pop_all()
        self._device = device
        self._told: tuple[int, Iterator[tuple[int, Indices, NDArray[np.float64]]]] | None = None

    def can_steer(self) -> bool:
        """Whether the device can list stale tiles itself."""
        return self._sweep.steering is not None

    def changes(self) -> Changes:
        """By how much the totals of the splats that are left have changed since the last call; all, at the first.

        See :mod:`potr_cl.stages.pruning.travelling_totals`; valid until the next call.
        """
        sweep = self._sweep
        if self._changed is None:
            self._changed = self._owned.enter_context(ChangedTotals(self._device, sweep.splats, sweep.marks))
        sweep.measure_on_device()
        return self._changed.take(sweep.totals)

    def lend_totals(self) -> Lent:
        """The totals, for others of this process to read from the device until the next command.

        Those of all splats, or of those that are left, as :class:`AlivePacking` has them.
        """
        self._sweep.measure_on_device()
        return self._alive.lend(self._sweep.totals)

    def remove_marked(self, splats: Bits) -> None:
        """Take splats out for good, a bit each (:meth:`Survivors.just_marked`)."""
        if self._sweep.steering is None:
            marked = np.unpackbits(splats, count=self._sweep.splats, bitorder="little")
            self._sweep.remove(np.flatnonzero(marked))
        else:
            self._sweep.mark(splats)
            self._sweep.remove_marked()
        self._alive.note()

    def replace_sh(self, sh: FloatArray) -> None:
        """Go on with other colours."""
        self._sweep.replace_sh(sh)

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured."""
        self._told = None
        self._sweep.sweep_changed()

    def importances(self, place: int) -> tuple[int, NDArray[np.uint32], NDArray[np.float64]] | None:
        """What is known of one view after :meth:`sweep_changed`.

        Args:
            place: of the view in this part; fastest one after the other.

        Returns:
            The view's number among all, the splats that it sees, ascending, and the mean of T α of each over its
            pixels; None behind the last view.
        """
        if self._told is None or self._told[0] != place:
            known = self._sweep.known_importances()
            for _ in range(place):
                next(known, None)
        else:
            known = self._told[1]
        found = next(known, None)
        self._told = (place + 1, known)
        return None if found is None else (found[0], found[1].astype(np.uint32), found[2])

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()


#: Splats a work-group of the kernel that adds totals.
_GROUP = 64


class SharedRemoval(Owner):
    """What :class:`potr_cl.stages.pruning.removal.RemovalSweep` does, with the help of others.

    Args:
        device: the master's.
        splats: N.
        cameras: all views.
        own: measures the master's share of the views; None if it has none.
        others: parts, each a :class:`potr_cl.stages.pruning.shared_removal.RemovalPart`, that measure the rest.
        pool: of their workers.
        steers: whether the choice of splats is the master's device's, as with the views on one GPU.
        numbers: of each part's splats, (n,) int64, ascending, where it has no others and knows them by their places;
            None: all parts have all.

    Attributes:
        device, splats, totals, marks, units: as of a :class:`~potr_cl.stages.pruning.removal.RemovalSweep`.
        steering: itself, if it steers; else None.

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
        assert numbers is None or pool.sparse
        self.device, self.splats, self._own, self._others, self._numbers = device, splats, own, others, numbers
        self._fixed_point = FixedPoint.of_views(cameras)
        self.units = self._fixed_point.units
        self._survivors: Survivors | None = None
        self._relay: Relay | None = None
        self._added: AddedChanges | None = None
        self._numbers_there: dict[int, tuple[int, cl.Buffer]] = {}
        with ExitStack() as owned:
            memory, stride = owned.enter_context(Memory(device)), stride_of(splats)
            self.totals: cl.Buffer = memory.upload(zero_totals(stride), "the removal effects")
            self._more = owned.enter_context(Scratch(device, "the removal effects"))
            self._staging = owned.enter_context(Staging(device))
            if own is None:
                self._survivors = owned.enter_context(Survivors(device, splats, stride, device.finish))
                self.marks: cl.Buffer = self._survivors.buffer
            else:
                self.marks = own.marks
            self._add = device.kernel("prune/add_totals.cl", "add_totals")
            if pool.sparse:
                assert own is None, "changes are added to the totals, which therefore are those of the others alone"
                self._added = owned.enter_context(AddedChanges(device))
                for place, theirs in enumerate(numbers or ()):
                    buffer = memory.upload(theirs.astype(np.uint32), "the splats of workers")
                    self._numbers_there[place] = len(theirs), buffer
            else:
                self._relay = owned.enter_context(Relay(device))
                self._alive = owned.enter_context(AlivePacking(device, splats, self.marks))
            self._owned = owned.pop_all()
        self.steering: SharedRemoval | None = self if steers else None

    @property
    def _states(self) -> RemovalSweep | Survivors:
        """Who knows which splats are left."""
        found = self._survivors or self._own
        assert found is not None
        return found

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._states.alive

    # ------------------------------------------------------------------------------ for a controller on the device

    def measure_on_device(self) -> None:
        """Bring :attr:`totals` up to date."""
        pending = self._others.begin("lend_totals" if self._added is None else "changes")
        if self._own is not None:
            self._own.measure_on_device()
        if self._added is None:
            self._fetch(pending.results())
        else:
            for place, changes in enumerate(pending.results()):
                splats, numbers = self._numbers_there.get(place, (self.splats, None))
                self._added.add(self.totals, changes, splats, numbers)
        if self._own is not None:
            self._add_to_totals(self._own.totals)

    def _fetch(self, found: Sequence[Lent]) -> None:
        """Have as totals the sum of what others lend."""
        assert self._relay is not None
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
        """Take the splats out that are marked JUST_REMOVED."""
        # The others go on with it while the master's device does its own, and whoever tells them more waits for them.
        self._tell(self._states.just_marked())
        if self._own is not None:
            self._own.remove_marked()
        elif self._survivors is not None:
            self._survivors.marked_by_device()
            self._survivors.settle()
        self._note()

    def _tell(self, marked: Bits) -> None:
        """Have the others remove splats, a bit each, without waiting for them."""
        told: Bits | Each = marked
        if self._numbers is not None:
            meant = np.unpackbits(marked, count=self.splats, bitorder="little")
            told = Each([np.packbits(meant[own], bitorder="little") for own in self._numbers])
        self._others.begin("remove_marked", told)

    def _note(self) -> None:
        """What others lend is packed by the splats that are left from now on."""
        if self._relay is not None:
            self._alive.note()

    # ----------------------------------------------------------------------------------- for a controller on the host

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        self.measure_on_device()
        return self._fixed_point.values(self._staging.download(self.totals, (self.splats, 2), np.int64))

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        gone = np.zeros(self.splats, bool)
        gone[splats] = True
        self._tell(np.packbits(gone, bitorder="little"))
        self._states.remove(splats)
        self._note()

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
            yield number, seen.astype(np.int64) if self._numbers is None else self._numbers[part][seen], importances
            place += 1

    def close(self) -> None:
        """Give the master's device memory back; the parts are the caller's."""
        self._owned.close()
