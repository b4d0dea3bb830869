"""Sweeps of the streamed views: prepared, swept and forgotten, whenever they are measured: :class:`StreamedSweep`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceMemoryError
from potr_cl.host import mapped
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.stages.pruning.buffers import Ledger, PreparedSet, SplatState, Survivors, shared_kernel
from potr_cl.stages.pruning.sweep import FixedPoint, SetKernels, SweepOptions, TileLists
from potr_cl.views.budget import target_bytes
from potr_cl.views.engine import Ready, ViewEngine
from potr_cl.views.subsets import Left, Subset

#: Splats that a work-group of the kernel `lost` looks at, and its work-items.
_LOST_CHUNK, _GROUP = 4096, 64

_Set: TypeAlias = "tuple[int, ...]"


class StreamedSweep(Owner):
    """Measures the views of which nothing stays but the pictures that they are compared with.

    Attributes:
        totals: (N, 2) int64, their part of the totals.
        known: whether the totals are right but for what was removed since.
    """

    def __init__(
        self, engine: ViewEngine[PreparedSet], survivors: Survivors, options: SweepOptions, fixed_point: FixedPoint
    ) -> None:
        self._engine, self._survivors, self._options, self._fixed_point = engine, survivors, options, fixed_point
        self._device = device = engine.device
        self.tiles_swept = 0
        self.known = False
        self._on_host: dict[_Set, FloatArray] = {}
        self._on_device: dict[_Set, cl.Buffer] = {}
        #: Whether all have been measured, so that pictures are compared with.
        self._measured = False
        self._single = {number: group for group in engine.plan.groups for number in group.numbers}
        self._memory, self._ferry = Memory(device), Ferry(device)
        self._scratch = [Scratch(device, what) for what in ("tiles", "staleness", "counters")]
        self._tiles, self._stale, self._listed = self._scratch
        if engine.streamed:
            with device.all_or_nothing():
                self.totals = self._memory.allocate(16 * engine.source.stride, "the effects in streamed views")
                self._words_lost = self._memory.allocate(8, "the importance that has gone")
            self._make_room_for_targets()

    def _make_room_for_targets(self) -> None:
        """Pictures stay on the device while there is room; the others go to the host."""
        room = self._engine.plan.budget.of_pictures(self._engine.streamed)
        for group in self._engine.streamed:
            for numbers in self._engine.sets(group):
                nbytes = sum(target_bytes(self._engine.cameras[number]) for number in numbers)
                if nbytes <= room:
                    with suppress(DeviceMemoryError):
                        self._on_device[numbers] = self._memory.allocate(nbytes, "the target images")
                        room -= nbytes

    def forget(self) -> None:
        """Have the next measurement measure all of them."""
        self.known = False

    def are_stale(self) -> bool:
        """Whether they have lost more than they may since they were measured: a part of their area, on average."""
        views = sum(len(group.numbers) for group in self._engine.streamed)
        limit = self._engine.plan.patience * self._options.tolerance
        if not self.known or limit <= 0:
            return bool(views)
        device, splats, words = self._device, self._engine.source.splats, self._words_lost
        device.fill(words, np.int64(0))
        lost = shared_kernel(device, "lost")
        lost.bind(states=self._survivors.buffer, totals=self.totals, splats=splats, importance=words)
        lost.launch((-(-splats // _LOST_CHUNK) * _GROUP,), (_GROUP,))
        importance = int(device.download(words, (1,), np.int64)[0])
        part = views / len(self._engine.cameras)
        return importance * self._fixed_point.units[1] / part > limit

    def measure(self) -> None:
        """Bring their totals up to date."""
        engine, device = self._engine, self._device
        device.fill(self.totals, np.uint32(0))
        for group in engine.streamed:
            with engine.stream(group, self._left) as subset:
                if subset is None:
                    continue
                with Ledger(self._survivors, self.totals, subset) as ledger:
                    for numbers in engine.sets(group):
                        with engine.prepared(numbers, subset, self._on_device.get(numbers)) as ready:
                            target, tiles = ready.work.target, ready.views.tiles
                            if numbers in self._on_host:
                                self._ferry.to_device(target, [Cargo(self._on_host[numbers])])
                            self._sweep(ready, ledger, not self._measured)
                            device.finish()
                            if not self._measured and numbers not in self._on_device:
                                kept = mapped.array((3 * ready.views.pixels,), np.float32, "target pictures")
                                self._ferry.to_host([Cargo(kept)], target)
                                self._on_host[numbers] = kept
                            self.tiles_swept += tiles
                    ledger.add_to(self.totals)
                    device.finish()
        engine.source.forget_scratch()
        self.known = self._measured = True

    @contextmanager
    def swept(self, number: int) -> Iterator[tuple[Subset, PreparedSet] | None]:
        """One view and its sums, with the splats that are left, inside the block; None: it shows none of them."""
        engine = self._engine
        with engine.stream(replace(self._single[number], numbers=(number,)), self._left) as subset:
            if subset is None:
                yield None
                return
            with Ledger(self._survivors, None, subset) as ledger, engine.prepared((number,), subset) as ready:
                self._sweep(ready, ledger, first_time=True)
                self._device.finish()
                yield subset, ready.work

    @property
    def _left(self) -> Left:
        mask = self._survivors.alive if self._engine.source.copies else None
        return Left(self._survivors.buffer, SplatState.ALIVE, mask)

    def _sweep(self, ready: Ready[PreparedSet], ledger: Ledger, first_time: bool) -> None:
        """Enqueue the sweep of all tiles of a set, which finds no removed splats in its lists."""
        tiles = ready.views.tiles
        self._stale.reserve(4 * tiles)
        self._listed.reserve(4)
        if self._tiles.reserve(4 * tiles):  # all of them: nobody writes to it
            self._device.copy(self._tiles.buffer, np.arange(tiles, dtype=np.uint32))
        lists = TileLists(self._tiles.buffer, self._stale.buffer, self._listed.buffer)
        kernels = SetKernels(ready, ledger, lists, self._options, self._fixed_point, first_time)
        if not self._engine.source.selects:
            kernels.take_out()
        kernels.sweep(0, tiles)

    def close(self) -> None:
        for owner in (*self._scratch, self._ferry, self._memory):
            owner.close()
