"""Sweeps of the resident views: a tile in which little has changed since its last sweep keeps its sums.

The totals hold what each tile added at its last sweep; sweeping a tile again replaces its part exactly, because all
sums are integers. GPU kernels list the tiles to sweep themselves, right after a removal, and the host learns only how
many they are; for CPU kernels, and where views take turns, the host chooses when it comes to the sweep
(:class:`TileSchedule`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import TypeVar

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.stages.pruning.buffers import Ledger, PreparedSet, Survivors
from potr_cl.stages.pruning.sweep import FixedPoint, SetKernels, SweepOptions, TileLists, family_of
from potr_cl.views.engine import ViewEngine

T = TypeVar("T")

Indices = NDArray[np.int64]

#: Queues on which sets of single views are swept beside each other.
_SINGLY = 8


class Queues:
    """The device's own queue, which nobody has to wait for as it does one thing after the other; or several others.

    Args:
        most: queues to open, where the device takes more than its own.
    """

    def __init__(self, device: Device, most: int) -> None:
        self._device = device
        self._others: list[cl.CommandQueue] = []
        if most > 1 and device.several_queues:
            properties = device.queue.properties
            self._others = [cl.CommandQueue(device.context, device.info.handle, properties) for _ in range(most)]

    def dealt(self, work: Iterable[T]) -> Iterator[tuple[T, cl.CommandQueue]]:
        """Each piece of work with the queue that it goes to, after what the device's own has; :meth:`wait` for all."""
        if self._others:
            self._device.finish()
        for piece, queue in zip(work, itertools.cycle(self._others or [self._device.queue])):
            yield piece, queue
            with self._device.errors("failed while computing"):
                queue.flush()

    def wait(self) -> None:
        """What the device's own queue is given from now on comes after all that was dealt."""
        with self._device.errors("failed while computing"):
            for queue in self._others:
                queue.finish()


class TileSchedule:
    """Chooses the tiles of a measurement by staleness, and in turns.

    A tile's staleness is the importance removed from it since its last sweep, as far as it counts, as a part of its
    area; infinite before the first sweep.

    Args:
        options: tolerance and turns.
        views: (number among the cameras, tiles) of the views whose tiles are numbered through, in their order.
    """

    def __init__(self, options: SweepOptions, views: Sequence[tuple[int, int]]) -> None:
        self._options = options
        self._numbers = np.array([number for number, _ in views], np.int64)
        self._tiles = np.array([tiles for _, tiles in views], np.int64)

    def choose(self, measurement: int, stale: NDArray[np.float32]) -> Indices:
        """The tiles that a measurement sweeps, ascending.

        Args:
            measurement: its number, from 0. The first takes no turns.
            stale: (tiles,) each tile's staleness.
        """
        options = self._options
        wanted = stale > options.tolerance
        if options.turns > 1 and measurement > 0:
            wanted &= np.repeat((measurement + self._numbers) % options.turns == 0, self._tiles)
        return np.flatnonzero(wanted)

    def changed(self, stale: NDArray[np.float32]) -> Indices:
        """The tiles that anything was removed from since their last sweep, ascending."""
        return np.flatnonzero(stale > 0)

    def note_swept(self, stale: NDArray[np.float32], tiles: Indices) -> None:
        """Write into ``stale`` that tiles were swept. With a negative tolerance they are stale again at once."""
        stale[tiles] = 0 if self._options.tolerance >= 0 else np.inf


def by_set(tiles: Indices, firsts: Sequence[int]) -> tuple[NDArray[np.uint32], list[int]]:
    """Tiles that are numbered through all sets as the list that sets are swept from.

    Args:
        tiles: their numbers, ascending.
        firsts: each set's first tile, ascending, and the end of the last one.

    Returns:
        (firsts[-1],) uint32, from each set's first tile on the numbers of its chosen tiles within it; and how many
        these are, set by set.
    """
    starts = np.searchsorted(tiles, firsts)
    counts = np.diff(starts)
    listed = np.zeros(firsts[-1], np.uint32)
    own = np.repeat(np.asarray(firsts[:-1], np.int64), counts)
    listed[own + np.arange(len(tiles)) - np.repeat(starts[:-1], counts)] = tiles - own
    return listed, counts.tolist()


class ResidentSweep(Owner):
    """Keeps the resident views' part of all totals up to date.

    Args:
        totals: (N, 2) int64 on the device, by the splats' numbers in the scene.
        options: which tiles are swept again. fixed_point: the totals' units.

    Attributes:
        queues: on which sets are swept beside each other.
        device_lists: whether kernels list the tiles.
    """

    def __init__(
        self,
        engine: ViewEngine[PreparedSet],
        survivors: Survivors,
        totals: cl.Buffer,
        options: SweepOptions,
        fixed_point: FixedPoint,
    ) -> None:
        self._engine, self._survivors, self._totals = engine, survivors, totals
        self._options, self._device = options, engine.device
        self._sets = sets = engine.resident
        family = family_of(self._device)
        # Sets that share the memory of their projections have to be swept one after the other.
        shares = any(ready.shares for ready in sets)
        most = 1 if shares else min(_SINGLY if engine.plan.singly else family.most_queues, len(sets))
        self.queues = Queues(self._device, most)
        self.device_lists = family.lists_tiles and options.only_by_tolerance
        self.tiles_swept = self._measurements = 0
        self._firsts = np.cumsum([0, *(ready.views.tiles for ready in sets)]).tolist()
        self._counts: list[int] | None = None  # listed tiles of each set; None: the host has yet to choose
        self._targets_known = False
        tiles = [
            (number, view.tiles)
            for ready in sets
            for number, view in zip(ready.numbers, ready.views.views, strict=True)
        ]  # fmt: skip
        self._schedule = TileSchedule(options, tiles)
        self._kernels: list[SetKernels] = []
        with ExitStack() as owned:
            memory = owned.enter_context(Memory(self._device))
            subsets = {id(ready.subset): ready.subset for ready in sets}
            ledgers = {key: owned.enter_context(Ledger(survivors, totals, subset)) for key, subset in subsets.items()}
            self._ledgers = list(ledgers.values())
            if sets:
                self._tiles = memory.allocate(4 * self._firsts[-1], "the tiles to sweep")
                self._stale = memory.allocate(4 * self._firsts[-1], "the tiles' staleness")
                self._listed = memory.allocate(4 * len(sets), "the numbers of tiles to sweep")
                lists = TileLists(self._tiles, self._stale, self._listed)
                for place, ready in enumerate(sets):
                    ready.work.first_tile = self._firsts[place]
                    ledger = ledgers[id(ready.subset)]
                    self._kernels.append(SetKernels(ready, ledger, lists, options, fixed_point, True, place))
                self.list_everything()
            self._owned = owned.pop_all()

    def gather(self) -> bool:
        """Where kernels add by places, make the totals anew of what they have added; whether that was done."""
        local = [ledger for ledger in self._ledgers if ledger.is_local]
        if local:
            self._device.fill(self._totals, np.int64(0))
            for ledger in local:
                ledger.add_to(self._totals)
        return bool(local)

    def list_stale(self) -> None:
        """List the tiles that the next measurement sweeps, unless the device has."""
        if self._counts is None:
            self._survivors.settle()
            self._take_marks()
            self._choose(self._schedule.choose(self._measurements, self._staleness()))
        self._measurements += 1

    def sweep(self) -> None:
        """Measure the tiles that are listed."""
        counts, self._counts = self._counts or [], [0] * len(self._sets) if self.device_lists else None
        work = [(count, place) for place, count in enumerate(counts) if count]
        if self._engine.plan.copies_rest:  # there is room for one copy at a time
            by_copy: dict[int, list[tuple[int, int]]] = {}
            for count, place in work:
                by_copy.setdefault(id(self._sets[place].subset), []).append((count, place))
            parts = list(by_copy.values())
        else:
            parts = [work] if work else []
        for part in parts:
            # The longest first, so that nothing long begins at the end.
            part.sort(key=lambda each: -each[0])
            for (count, place), queue in self.queues.dealt(part):
                self._engine.project(self._sets[place])
                self._kernels[place].sweep(self._firsts[place], count, queue)
            self.queues.wait()
            if self._engine.plan.copies_rest:
                self._engine.source.rest(self._sets[part[0][1]].subset)
        self.tiles_swept += sum(counts)
        if not self._targets_known and self._measurements:
            for kernels in self._kernels:
                kernels.target_is_known()
            self._targets_known = True

    def sweep_changed(self) -> None:
        """Measure every tile that has lost anything since its last sweep."""
        if self.device_lists:
            self.note_removal(0.0)
        else:
            self._settle()
            self._choose(self._schedule.changed(self._staleness()))
        self.sweep()

    def prepare_removal(self) -> None:
        """To be called before splats are marked as removed by the host."""
        if not self.device_lists:
            self._settle()

    def note_removal(self, tolerance: float | None = None) -> None:
        """Find out how much each tile has lost of what was marked as JUST_REMOVED.

        Args:
            tolerance: list the tiles that are staler than this; None: as the options say.
        """
        if not self._sets:
            return
        if not self.device_lists:
            self._take_marks()
            for kernels, queue in self.queues.dealt(self._kernels):
                kernels.note_removal(queue)
            self._counts = None
            return
        self.sweep()
        above = self._options.tolerance if tolerance is None else tolerance
        self._device.fill(self._listed, np.uint32(0))
        for kernels, queue in self.queues.dealt(self._kernels):
            kernels.note_removal(queue, list_above=above)
        self.queues.wait()
        self._counts = self._device.download(self._listed, (len(self._sets),), np.uint32).tolist()

    def list_everything(self) -> None:
        """Have the next measurement sweep every tile."""
        if not self._sets:
            return
        self._settle()
        counts = [ready.views.tiles for ready in self._sets]
        if self.device_lists:
            self._device.copy(self._tiles, np.concatenate([np.arange(count, dtype=np.uint32) for count in counts]))
            self._counts = counts
        self._device.fill(self._stale, np.float32(0 if self.device_lists else np.inf))

    def project_again(self) -> None:
        """Have all sets show the colours that the source has by now."""
        self._settle()
        for ready in self._sets:
            source = self._engine.source
            source.recolour(ready.subset)
            if not ready.shares:
                source.project(ready.subset, ready.views)
                if self._engine.plan.copies_rest:
                    source.rest(ready.subset)
        self._engine.source.forget_scratch()

    # ---------------------------------------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Sweep what the device has listed, and have host and device agree on the splats that are left."""
        if self._counts is not None and self._targets_known:
            self.sweep()
        self._survivors.settle()
        self._take_marks()

    def _take_marks(self) -> None:
        for ledger in self._ledgers:
            ledger.take_marks()

    def _staleness(self) -> NDArray[np.float32]:
        if not self._sets:
            return np.zeros(0, np.float32)
        return self._device.download(self._stale, (self._firsts[-1],), np.float32)

    def _choose(self, tiles: NDArray[np.int64]) -> None:
        """List tiles of all sets, numbered through, ascending."""
        listed, self._counts = by_set(tiles, self._firsts)
        if len(tiles):
            self._device.copy(self._tiles, listed)
            stale = self._staleness()
            self._schedule.note_swept(stale, tiles)
            self._device.copy(self._stale, stale)
