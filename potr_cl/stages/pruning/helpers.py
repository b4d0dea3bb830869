"""Removal effects of a state (:func:`measurement`), whose views may be measured by several: :class:`RemovalPart` does
some of them on a worker, and :class:`RemovalHelpers` takes to the master's device what they find.

All totals are integers, in units that follow from all views (:class:`potr_cl.stages.pruning.sweep.FixedPoint`). So it
makes no difference to any bit who measures which view. The master's device adds up: what other devices of this process
lend, or what has changed elsewhere since it was last told (:mod:`~potr_cl.stages.pruning.exchange`). What is decided is
decided in one place, from the sums: by :mod:`potr_cl.stages.pruning.schedule`, or on the master's device by
:mod:`potr_cl.stages.pruning.controller`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.raster.resident import DeviceScene, SceneHandle, scene_on, whole_on_device
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.stages.pruning.buffers import Bits
from potr_cl.stages.pruning.exchange import AddedChanges, AlivePacking, ChangedTotals, Changes, add_totals
from potr_cl.stages.pruning.removal import F64, Indices, RemovalSweep, Wanted, planned_sweep
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.plan import none
from potr_cl.views.shares import ViewShares
from potr_cl.views.subsets import NoSplats
from potr_cl.views.targets import PicturesInPassing
from potr_cl.views.visibility import Visibility
from potr_cl.workers.parts import Each, Parts, Pending
from potr_cl.workers.pool import Part, Pool, shares


class RemovalPart(Part):
    """Some of the views; see :class:`potr_cl.stages.pruning.removal.RemovalSweep`.

    Args:
        memory: bytes of its memory that the views may take; None: the default.
        scene: the uncompressed scene, perhaps on devices; or of it what these views may draw
            (:mod:`potr_cl.views.shares`).
        wanted: what is measured, with the numbers of this part's views.
    """

    def __init__(self, device: Device, memory: int | None, scene: Scene | SceneHandle, wanted: Wanted) -> None:
        wanted = replace(wanted, options=replace(wanted.options, memory=memory))
        with ExitStack() as owned:
            drawable = owned.enter_context(scene_on(device, scene))
            if wanted.visibility is not None:
                drawable = owned.enter_context(whole_on_device(device, drawable))
            self._sweep = owned.enter_context(planned_sweep(device, drawable, wanted))
            self._alive = owned.enter_context(AlivePacking(device, self._sweep.splats, self._sweep.marks))
            self._changed: ChangedTotals | None = None
            self._owned = owned.pop_all()
        self._device = device
        self._told: tuple[int, Iterator[tuple[int, Indices, NDArray[np.float64]]]] | None = None

    def can_steer(self) -> bool:
        """Whether the device can list stale tiles itself."""
        return self._sweep.can_steer

    def changes(self, again: bool | None = None) -> Changes:
        """By how much the totals of the splats that are left have changed since the last call; all, at the first.

        See :mod:`potr_cl.stages.pruning.exchange`; valid until the next call.

        Args:
            again: as of :meth:`RemovalSweep.measure_on_device`.
        """
        sweep = self._sweep
        if self._changed is None:
            self._changed = self._owned.enter_context(ChangedTotals(self._device, sweep.splats, sweep.marks))
        sweep.measure_on_device(again=again)
        return self._changed.take(sweep.totals)

    def lend_totals(self, again: bool | None = None) -> Lent:
        """The totals, for others of this process to read from the device until the next command.

        Those of all splats, or of those that are left, as :class:`AlivePacking` has them.

        Args:
            again: as of :meth:`RemovalSweep.measure_on_device`.
        """
        self._sweep.measure_on_device(again=again)
        return self._alive.lend(self._sweep.totals)

    def remove_marked(self, splats: Bits) -> None:
        """Take splats out for good, a bit each (:meth:`Survivors.just_marked`)."""
        self._sweep.remove_bits(splats)
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
            known: Iterator[tuple[int, Indices, F64]] = islice(self._sweep.known_importances(), place, None)
        else:
            known = self._told[1]
        found = next(known, None)
        self._told = (place + 1, known)
        return None if found is None else (found[0], found[1].astype(np.uint32), found[2])


class RemovalHelpers(Owner):
    """What others measure, for the :class:`potr_cl.stages.pruning.removal.RemovalSweep` of the master's device.

    Args:
        splats: N.
        others: parts, each a :class:`RemovalPart`.
        numbers: of each part's splats, (n,) int64, ascending, where it has no others and knows them by their places;
            None: all parts have all.
    """

    def __init__(
        self, device: Device, splats: int, others: Parts, pool: Pool, numbers: Sequence[Indices] | None = None
    ) -> None:
        assert numbers is None or not pool.in_process
        self._device, self._splats, self._others, self._numbers = device, splats, others, numbers
        self._relay: Relay | None = None
        self._added: AddedChanges | None = None
        self._alive: AlivePacking | None = None
        self._numbers_there: dict[int, tuple[int, cl.Buffer]] = {}
        with ExitStack() as owned:
            memory = owned.enter_context(Memory(device))
            self._more = owned.enter_context(Scratch(device, "the removal effects"))
            if not pool.in_process:
                self._added = owned.enter_context(AddedChanges(device))
                for place, theirs in enumerate(numbers or ()):
                    buffer = memory.upload(theirs.astype(np.uint32), "the splats of workers")
                    self._numbers_there[place] = len(theirs), buffer
            else:
                self._relay = owned.enter_context(Relay(device))
            self._owned = owned.pop_all()

    @cached_property
    def can_steer(self) -> bool:
        """Whether all of them can list stale tiles themselves."""
        return all(self._others.ask(place, "can_steer") for place in range(len(self._others)))

    def begin(self, again: bool | None = None) -> Pending:
        """Have them measure, streamed views ``again`` or if they have lost enough (None); :meth:`take` follows."""
        return self._others.begin("changes" if self._relay is None else "lend_totals", again)

    def take(self, pending: Pending, totals: cl.Buffer) -> None:
        """Have as totals, (N, 2) int64 that nobody else changes, the sum of what they have measured."""
        for place, found in enumerate(pending.results()):
            if self._added is not None:
                splats, numbers = self._numbers_there.get(place, (self._splats, None))
                self._added.add(totals, found, splats, numbers)
                continue
            assert self._relay is not None
            assert self._alive is not None
            packed = self._alive.are_packed(found)
            if place == 0 and not packed:
                self._relay.fetch(totals, found)
                continue
            self._more.reserve(found.nbytes)
            self._relay.fetch(self._more.buffer, found)
            if packed:
                self._alive.unpack(self._more.buffer, totals, add=place > 0)
            else:
                add_totals(self._device, totals, self._more.buffer, self._splats)

    def remove(self, marked: Bits) -> None:
        """Have them remove splats, a bit each, without waiting for them."""
        told: Bits | Each = marked
        if self._numbers is not None:
            meant = np.unpackbits(marked, count=self._splats, bitorder="little")
            told = Each([np.packbits(meant[own], bitorder="little") for own in self._numbers])
        self._others.begin("remove_marked", told)

    def are_left(self, marks: cl.Buffer, first: bool = False) -> None:
        """What they lend is packed by these marks from now on; ``first``: nobody has removed anything yet."""
        if self._relay is None:
            return
        if self._alive is None:
            self._alive = self._owned.enter_context(AlivePacking(self._device, self._splats, marks))
        if not first:
            self._alive.note()

    def replace_sh(self, sh: FloatArray) -> Pending:
        """Have them go on with other colours."""
        # Copies: who does a lost worker's views later is told the same, whatever has become of the caller's array.
        told = sh.copy() if self._numbers is None else Each([sh[own] for own in self._numbers])
        return self._others.begin("replace_sh", told)

    def sweep_changed(self) -> Pending:
        """Have them measure whatever anything was removed from; :meth:`importances` are known then."""
        return self._others.begin("sweep_changed")

    def importances(self) -> list[Iterator[tuple[int, Indices, F64]]]:
        """As of :meth:`RemovalSweep.known_importances`, of each part."""
        return [self._importances_of(place) for place in range(len(self._others))]

    def _importances_of(self, part: int) -> Iterator[tuple[int, Indices, F64]]:
        place = 0
        while (found := self._others.ask(part, "importances", place)) is not None:
            number, seen, importances = found
            yield number, seen.astype(np.int64) if self._numbers is None else self._numbers[part][seen], importances
            place += 1


@contextmanager
def measurement(
    state: State,
    bench: Workbench,
    options: SweepOptions,
    visibility: Visibility | None = None,
    dealt: ViewShares | None = None,
    seen: NDArray[np.int64] | None = None,
    pictures: PicturesInPassing | None = None,
) -> Iterator[RemovalSweep]:
    """A removal sweep over the views of a state, its splats numbered as in the state's scene.

    Args:
        visibility: what the views see, where each had better be looked at with what it sees.
        dealt: the views, for a pool whose workers get what these see and no more of the scene.
        seen: (n,) numbers of the splats that the sweep is to have, ascending, which it numbers from 0 on; None: all.
        pictures: as of :class:`potr_cl.stages.pruning.removal.RemovalSweep`.
    """

    def progress(done: int, count: int) -> None:
        bench.progress("prepare views", done / count)

    device, pool, views = bench.opened, bench.pool, state.views
    wanted = Wanted(views, options, bench.background, visibility)
    splats = len(state.scene) if seen is None else len(seen)
    share = None if pool is None else shares(pool, len(views))
    with ExitStack() as stack:
        if pool is None or share is None or not share.others:
            scene = None
            if visibility is not None:
                scene = state.scene if seen is None else state.scene.subset(seen)
                whole = stack.enter_context(whole_on_device(device, bench.drawable(scene)))
            else:
                whole = stack.enter_context(scene_on(device, bench.scene_of(state, seen)))
            yield stack.enter_context(planned_sweep(device, whole, wanted, scene, progress, None, pictures))
            return
        given: list[tuple[Any, Wanted]] = []
        drawable: Drawable | None = None
        if dealt is not None:
            share = dealt.dealt
            for part in dealt.shares:
                subset = stack.enter_context(pool.shared(part.subset))
                given.append((subset, replace(wanted, numbers=part.numbers, visibility=part.visibility)))
        else:
            if pool.in_process:
                placed: Scene | SceneHandle = bench.scene_of(state, seen)
                drawable = stack.enter_context(scene_on(device, placed))
                if visibility is not None:
                    drawable = stack.enter_context(whole_on_device(device, drawable))
                if isinstance(drawable, SceneBuffers) and isinstance(placed, Scene):
                    # Others copy it from there: to make it ready on the host once more would take longer.
                    placed = DeviceScene(drawable)
                sent = stack.enter_context(pool.shared(placed))
            else:
                sent, visibility = stack.enter_context(bench.shared(pool, state, seen)), None
            given = [(sent, replace(wanted, numbers=numbers, visibility=visibility)) for numbers in share.others]
        parts = stack.enter_context(Parts(pool, RemovalPart, given, options.memory, share.names))
        numbers = None if dealt is None else [each.splats for each in dealt.shares]
        helpers = stack.enter_context(RemovalHelpers(device, splats, parts, pool, numbers))
        if drawable is not None and share.own:
            own = replace(wanted, numbers=share.own)
            sweep = stack.enter_context(planned_sweep(device, drawable, own, None, progress, helpers, pictures))
        else:
            source = NoSplats(device, splats)
            sweep = stack.enter_context(RemovalSweep(source, views, options, plan=none(), helpers=helpers))
        parts.ready()
        yield sweep


def importances_of(
    removal: RemovalSweep, left: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.float64]]]:
    """I_k(s) of the splats that are left, view by view.

    Args:
        removal: the sweep, which has measured.
        left: (n,) the sweep's numbers of the splats that are left, ascending.

    Yields:
        The number of the view, the numbers among those left of the splats that it sees, ascending, and the mean of T α
        of each over the view's pixels.
    """
    places = np.full(removal.splats, -1, np.int64)
    places[left] = np.arange(len(left))
    for view, seen, importances in removal.view_importances():
        yield view, places[seen], importances
