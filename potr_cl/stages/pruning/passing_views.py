"""Views of a large scene that a GPU has no room for, prepared whenever they are measured: :class:`PassingViews`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner, Reused, Scratch
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.picked_splats import Picker
from potr_cl.stages.pruning.kept_views import target_bytes
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.stages.pruning.shrinking_scene import ShrinkingScene
from potr_cl.stages.pruning.survivors import SplatState
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers
from potr_cl.stages.pruning.view_batches import Batch, Ready, dealt_out
from potr_cl.views.visibility import Visibility

_SOURCE = "prune/parts.cl"
_GROUP = 64
#: Splats that a work-group of the kernel `lost` looks at.
_LOST_CHUNK = 4096
#: They may lose so many times as much as a tile, on the average. With ten million splats and 300 views, none of them
#: kept, 2 and 0.5 cost 1.4 and 0.2 dB against views that are kept; 0.5 took 2.7 times as long as 2.
PATIENCE = 0.5


class PassingViews(Owner):
    """Views that are prepared again whenever they are measured, some neighbours at a time, with the splats still left.

    Their target pictures stay, if there is room for them.

    Args:
        scene: that they look at.
        cameras: all views, also those that are kept.
        picker: of the scene's splats by groups.
        totals: (N, 2) int64 that their effects are added to.
        listed: what kernels of views that are kept count in; nothing is counted for these.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(
        self, scene: ShrinkingScene, cameras: Sequence[Camera], picker: Picker, totals: cl.Buffer, listed: cl.Buffer
    ) -> None:
        self._scene, self._cameras, self._picker, self._totals, self._listed = scene, cameras, picker, totals, listed
        self._batches: list[Batch] = []
        #: Whether their own totals are right but for what was removed since, and whether the scene's have them.
        self._known = self._added = False
        device = scene.device
        self._memory = Memory(device)
        self._unwanted, self._tiles, self._stale, self._target = self._scratch = [
            Scratch(device, what)
            for what in ("some views' effects", "some views' tiles", "their staleness", "their targets")
        ]
        #: What one batch after the other takes.
        self._passing = Reused(device)

    @property
    def numbers(self) -> set[int]:
        """Which of all views they are."""
        return {number for batch in self._batches for number in batch.numbers}

    def take(
        self, others: Sequence[int], sights: Visibility, targets: NDArray[np.int64], passing: int, room: int
    ) -> None:
        """Measure these views, too.

        Args:
            others: their numbers, in an order in which neighbours see much of the same.
            sights: what each of all views may draw.
            targets: (all views,) bytes of their pictures.
            passing: bytes that views may take while they are there.
            room: bytes for their target pictures.
        """
        if not others:
            return
        nbytes = 16 * self._scene.whole.stride
        self._own_totals = self._memory.allocate(nbytes, "the effects in views that are not kept")
        self._words_lost = self._memory.allocate(8, "the importance that has gone")
        self._batches = dealt_out(others, sights, targets, passing)
        for batch in self._batches:
            nbytes = int(targets[batch.numbers].sum())
            if nbytes <= room:
                with suppress(DeviceMemoryError):
                    batch.targets = self._memory.allocate(nbytes, "the target images")
                    room -= nbytes

    def measure(self) -> None:
        """Bring the totals up to date, where they have lost enough since the last time."""
        if self._batches and self._are_stale():
            if self._added:
                self._with_own("subtract_totals")
            self._scene.device.fill(self._own_totals, np.uint32(0))
            for batch in self._batches:
                with self.swept(batch, self._own_totals):
                    pass
            self._with_own("add_totals")
            self._known = self._added = True

    def forget(self) -> None:
        """Have the next measurement measure all of them."""
        self._known = False

    def _with_own(self, name: str) -> None:
        splats = self._scene.whole.splats
        kernel = self._scene.device.shared_kernel("prune/add_totals.cl", name)
        kernel.bind(totals=self._totals, more=self._own_totals, count=2 * splats)
        kernel.launch((-(-2 * splats // _GROUP) * _GROUP,), (_GROUP,))

    def _are_stale(self) -> bool:
        """Whether they have lost more than the tolerance since they were measured: a part of their area, on average."""
        tolerance = self._scene.options.tolerance
        if not self._known or tolerance <= 0:
            return True
        device, splats, words = self._scene.device, self._scene.whole.splats, self._words_lost
        device.fill(words, np.int64(0))
        lost = device.shared_kernel(_SOURCE, "lost", **totals_limits(device))
        lost.bind(states=self._scene.survivors.buffer, totals=self._own_totals, splats=splats, importance=words)
        lost.launch((-(-splats // _LOST_CHUNK) * _GROUP,), (_GROUP,))
        importance = int(device.download(words, (1,), np.int64)[0])
        part = sum(len(batch.numbers) for batch in self._batches) / len(self._cameras)
        return importance * self._scene.fixed_point.units[1] / part > PATIENCE * tolerance

    @contextmanager
    def swept(self, batch: Batch, totals: cl.Buffer | None) -> Iterator[Ready | None]:
        """Some views prepared and swept, as long as the context lasts; None if none of their splats is left.

        Args:
            batch: the views.
            totals: (N, 2) int64 that their effects are added to; None: nobody wants them.
        """
        target, stored = batch.targets, batch.known
        if target is None:
            stored = False
            self._target.reserve(sum(target_bytes(self._cameras[number]) for number in batch.numbers))
            target = self._target.buffer
        if not stored and not self._scene.pristine:
            with self._ready(batch, target, whole=True) as views:
                assert views is not None
                views.kernels.store_target()
                self._scene.finish()
            stored = True
        with self._ready(batch, target, totals) as views:
            if views is not None:
                if stored:
                    views.kernels.target_is_known()
                views.kernels.sweep(0, views.prepared.views.tiles)
                self._scene.finish()
            batch.known = True
            yield views

    @contextmanager
    def _ready(
        self, batch: Batch, target: cl.Buffer, totals: cl.Buffer | None = None, whole: bool = False
    ) -> Iterator[Ready | None]:
        """Some views prepared, all their sums 0; None if there is no splat to prepare them with.

        Args:
            batch: the views.
            target: their pictures.
            totals: (N, 2) int64 that they are added to; None: nobody wants them.
            whole: with all splats, and with the colours of the target.
        """
        device, cameras = self._scene.device, [self._cameras[number] for number in batch.numbers]
        marks = self._scene.survivors.buffer
        with ExitStack() as stack:
            stack.callback(self._passing.close)
            states = None if whole else marks
            numbers, splats = self._picker.pick(self._passing, batch.wanted, states, SplatState.ALIVE)
            if not splats:
                yield None
                return
            rasterizer = stack.enter_context(self._scene.rasterizer(numbers, splats, former=whole))
            views = rasterizer.prepare_set(cameras, self._passing)
            prepared = PreparedSet(rasterizer, range(len(cameras)), views, self._passing, target)
            stack.enter_context(prepared)
            self._stale.reserve(4 * views.tiles)
            if self._tiles.reserve(4 * views.tiles):  # all of them: nobody writes to it
                everything = np.arange(views.tiles, dtype=np.uint32)
                with device.errors("failed while computing"):
                    cl.enqueue_copy(device.queue, self._tiles.buffer, everything, is_blocking=True)
            if totals is None:
                self._unwanted.reserve(16 * rasterizer.stride)
            # The states are not looked at: what has gone is not among the splats.
            wanted = (self._unwanted.buffer, None) if totals is None else (totals, numbers)
            buffers = SweepBuffers(marks, self._tiles.buffer, self._stale.buffer, self._listed, *wanted)
            kernels = self._scene.launcher(rasterizer).bind(
                prepared, (views.shapes, views.colours), buffers, first_time=True
            )
            yield Ready(prepared, numbers, splats, kernels)

    def close(self) -> None:
        self._passing.give_back()
        for owner in (*self._scratch, self._memory):
            owner.close()
