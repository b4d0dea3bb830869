"""Removal effects of large scenes on a GPU, each view with the splats that it may draw: :class:`ViewByView`.

Of a large scene no view sees much. The whole scene lies on the device once; a view has its own numbers of splats, and
its projection and lists are of these and no others. What it measures is added to the scene's totals by the splats'
numbers there. Totals are integers in units that follow from all views, so they are the same bits as of all views with
all splats.

Views that the memory has no room for are prepared again whenever they are measured, some neighbours at a time and only
with the splats that are left; their target pictures stay, if there is room for them. They are measured when on the
average they have lost half as much since the last time as a tile may lose before it is swept again: some tiles lose far
more than the average.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import TypeGuard

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Reused, Scratch
from potr_cl.raster.culling import Sights
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.picked_splats import PickedSplats, Picker, Picks
from potr_cl.raster.rasterizer import PreparingMemory, Rasterizer
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.raster.view_set import TILE
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.kept_view import KeptView, View
from potr_cl.stages.pruning.launcher import launcher_for
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.stages.pruning.queues import Queues
from potr_cl.stages.pruning.removal import F64, Indices
from potr_cl.stages.pruning.survivors import Bits, SplatState, Survivors
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers
from potr_cl.stages.pruning.sweep_options import SweepOptions, default_memory
from potr_cl.stages.pruning.view_batches import Batch, Ready, dealt_out

_SOURCE = "prune/parts.cl"
_GROUP = 64
#: Splats that a work-group of the kernel `lost` looks at.
_LOST_CHUNK = 4096
#: Views that are swept at the same time: the longest list of one keeps a work-group busy when the others are done.
_QUEUES = 8
#: Bytes that a view is expected to take: of a splat (shape, colour, number, and two and a half tile intersections), and
#: of a pixel (the target).
_SPLAT, _PIXEL = 87, 12
#: Of the memory, what views may take that are made again.
_PASSING = 1 / 5
#: They may lose so many times as much as a tile, on the average. With ten million splats and 300 views, none of them
#: kept, 2 and 0.5 cost 1.4 and 0.2 dB against views that are kept; 0.5 took 2.7 times as long as 2.
_PATIENCE = 0.5


def can_go_by_view(scene: Drawable, device: Device, options: SweepOptions) -> TypeGuard[SceneBuffers]:
    """Whether a scene can be looked at view by view: on a GPU that has it, where staleness alone chooses tiles."""
    return isinstance(scene, SceneBuffers) and device.family == "gpu" and options.only_by_tolerance


class ViewByView(Owner):
    """What :class:`potr_cl.stages.pruning.removal.RemovalSweep` does, for large scenes on a GPU.

    Args:
        device: that computes.
        whole: the uncompressed scene on it.
        cameras: all views.
        sights: what each of them may draw.
        options: speed/accuracy trade-offs; tiles are chosen by their staleness alone.
        background: R, G, B behind the scene.
        progress: called with the views prepared and their number.
        first_totals: (N, 2) int64 that the scene's totals begin with; None: zeros.
        numbers: of the views that are measured here, where others are measured elsewhere and all totals are added up;
            None: all.

    Attributes:
        splats: N.
        device, totals, marks, units: see :class:`~potr_cl.stages.pruning.steering.Steered`.
        kept_views: views that stay prepared.

    Raises:
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        whole: SceneBuffers,
        cameras: Sequence[Camera],
        sights: Sights,
        options: SweepOptions,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        progress: Callable[[int, int], None] | None = None,
        first_totals: NDArray[np.int64] | None = None,
        numbers: Sequence[int] | None = None,
    ) -> None:
        self.device, self.splats = device, whole.splats
        self._whole, self._cameras, self._options, self._background = whole, cameras, options, background
        self._fixed_point = FixedPoint.of_views(cameras)
        self.units = self._fixed_point.units
        self._queues = Queues(device, _QUEUES)
        self._sh: cl.Buffer | None = None  # other coefficients than those of the targets
        self._kept: list[KeptView] = []
        self._unkept: list[Batch] = []
        #: Tiles of each kept view that the next measurement sweeps.
        self._listed: list[int] = []
        #: Whether every splat is left, and has the colours of the targets.
        self._pristine = True
        self._targets_known = self._unkept_known = False
        #: Whether the totals have what views that are not kept have added last.
        self._unkept_added = False
        self._seen = sights.seen
        own = np.ones(len(cameras), bool)
        if numbers is not None:
            own[:] = False
            own[list(numbers)] = True
        with ExitStack() as owned:
            self._memory = memory = owned.enter_context(Memory(device))
            owned.callback(self._close_kept)
            self._scratch = [
                owned.enter_context(Scratch(device, what))
                for what in ("some views' effects", "some views' tiles", "their staleness", "their targets")
            ]
            #: Of views that are not kept, one after the other.
            self._passing = Reused(device)
            owned.callback(self._passing.give_back)
            self._preparing = owned.enter_context(PreparingMemory(device))
            self.totals = memory.allocate(16 * whole.stride, "the removal effects")
            device.fill(self.totals, np.int64(0))
            if first_totals is not None:
                with device.errors("cannot hold the removal effects to begin with"):
                    cl.enqueue_copy(device.queue, self.totals, first_totals, is_blocking=True)
            self._survivors = owned.enter_context(
                Survivors(device, self.splats, whole.stride, lambda: self._queues.wait())
            )
            self.marks: cl.Buffer = self._survivors.buffer
            self._picker = owned.enter_context(Picker(device, sights.groups.group_of))
            with Memory(device) as picking:
                self._prepare_all(sights, own, Picks(picking, self._picker, sights.seen), progress)
            self._owned = owned.pop_all()
        self.kept_views = len(self._kept)

    @property
    def steering(self) -> ViewByView:
        """Itself: the device chooses."""
        return self

    # --------------------------------------------------------------------------------------------- preparing views

    def _prepare_all(
        self,
        sights: Sights,
        mine: NDArray[np.bool_],
        picks: Picks,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        device, memory = self.device, self._memory
        totals = np.where(mine, sights.totals, 0)
        targets = np.array([_PIXEL * camera.width * camera.height for camera in self._cameras]) * mine
        left = default_memory(device) if self._options.memory is None else self._options.memory
        tiles = [-(-camera.width // TILE) * -(-camera.height // TILE) for camera in self._cameras]
        self._stale = memory.upload(np.zeros(sum(tiles), np.float32), "the tiles' staleness")
        self._tiles = memory.allocate(4 * sum(tiles), "the tiles to sweep")
        self._counts = memory.allocate(4 * len(tiles), "the numbers of tiles to sweep")
        passing = int(_PASSING * left)
        # For the targets of all views that are not kept room is left, unless all will be kept.
        reserved = 0
        if _SPLAT * int(totals.sum()) + int(targets.sum()) > left:
            left -= passing + 16 * self._whole.stride
            reserved = int(targets.sum())
        self._pending: list[cl.Event] = []
        first_tile, others = 0, []
        for done, number in enumerate(sights.order().tolist()):
            own = int(targets[number])
            reserved = max(reserved - own, 0)
            if totals[number]:
                kept = self._keep(number, picks, left - reserved, first_tile)
                if kept:
                    first_tile += tiles[number]
                    left -= kept
                else:
                    others.append(number)
                    left -= own
            if progress is not None:
                progress(done + 1, len(self._cameras))
        self._list_everything()
        self._finish()
        self._pending.clear()
        if others:
            self._totals_of_unkept = memory.allocate(16 * self._whole.stride, "the effects in views that are not kept")
            self._words_lost = memory.allocate(8, "the importance that has gone")
            self._unkept = dealt_out(others, sights, targets, passing)
            room = left + int(targets[others].sum())
            for batch in self._unkept:
                nbytes = int(targets[batch.numbers].sum())
                if nbytes <= room:
                    with suppress(DeviceMemoryError):
                        batch.targets = memory.allocate(nbytes, "the target images")
                        room -= nbytes

    def _keep(self, number: int, picks: Picks, room: int, first_tile: int) -> int:
        """Prepare a view, and keep it if it takes no more than the room; returns the bytes that it takes, or 0."""
        device, camera, splats = self.device, self._cameras[number], picks.counts[number]
        if 2 / 3 * _SPLAT * splats + _PIXEL * camera.width * camera.height > room:
            return 0
        before = device.allocated
        with suppress(DeviceMemoryError), ExitStack() as stack:
            memory = stack.enter_context(Memory(device))
            view = View(number, camera, splats, picks.numbers(memory, number))
            rasterizer = stack.enter_context(self._rasterizer(view.numbers, splats))
            views = rasterizer.prepare_set([camera])
            # The device sorts its lists while the next view is made ready.
            prepared = PreparedSet(rasterizer, range(number, number + 1), views, pending=self._pending)
            stack.enter_context(prepared)
            rasterizer.rest()
            taken = device.allocated - before
            if taken > room:
                return 0
            prepared.first_tile = first_tile
            buffers = SweepBuffers(self.marks, self._tiles, self._stale, self._counts, self.totals, view.numbers)
            kernels = launcher_for(rasterizer, self._options, self._fixed_point).bind(
                prepared,
                (prepared.views.shapes, prepared.views.colours),
                buffers,
                first_time=True,
                place=len(self._kept),
            )
            self._kept.append(KeptView(view, prepared, memory, rasterizer, kernels))
            stack.pop_all()
            return taken
        return 0

    def _rasterizer(self, numbers: cl.Buffer, splats: int, former: bool = False) -> Rasterizer:
        """Of some splats, with the colours that they have now, or with those of the targets."""
        picked = PickedSplats(self._whole, numbers, splats)
        if self._sh is not None and not former:
            picked.sh = self._sh
        return Rasterizer(self.device, picked, background=self._background, preparing=self._preparing)

    # ------------------------------------------------------------------------------ for a controller on the device

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._survivors.alive

    def measure_on_device(self) -> None:
        """Bring the totals up to date."""
        self._sweep_listed()
        if self._unkept and self._unkept_are_stale():
            if self._unkept_added:
                self._with_unkept("subtract_totals")
            self._measure_unkept()
            self._with_unkept("add_totals")
            self._unkept_known = self._unkept_added = True

    def _with_unkept(self, name: str) -> None:
        kernel = self.device.shared_kernel("prune/add_totals.cl", name)
        kernel.bind(totals=self.totals, more=self._totals_of_unkept, count=2 * self.splats)
        kernel.launch((-(-2 * self.splats // _GROUP) * _GROUP,), (_GROUP,))

    def remove_marked(self) -> None:
        """Take the splats out that are marked JUST_REMOVED."""
        self._list_stale(self._options.tolerance)
        self._survivors.marked_by_device()
        self._pristine = False

    def mark(self, splats: Bits) -> None:
        """See :meth:`potr_cl.stages.pruning.steering.Steering.mark`."""
        self._survivors.mark(splats)

    def just_marked(self) -> Bits:
        """The splats that are marked JUST_REMOVED, see :meth:`Survivors.just_marked`."""
        return self._survivors.just_marked()

    def _sweep_listed(self) -> None:
        work = [(count, kept) for count, kept in zip(self._listed, self._kept, strict=True) if count]
        # The longest first, so that nothing long begins at the end.
        work.sort(key=lambda each: -each[0])
        self._queues.enqueue([partial(kept.sweep, count) for count, kept in work])
        self._queues.wait()
        self._listed = [0] * len(self._kept)
        if not self._targets_known:
            for kept in self._kept:
                kept.target_is_known()
            self._targets_known = True

    def _list_stale(self, tolerance: float) -> None:
        """Have all kept views note what has gone, and list the tiles that are staler than the tolerance."""
        self._sweep_listed()
        self.device.fill(self._counts, np.uint32(0))
        self._queues.enqueue([partial(kept.note_removal, tolerance) for kept in self._kept])
        self._queues.wait()
        self._listed = self.device.download(self._counts, (len(self._kept),), np.uint32).tolist()

    def _list_everything(self) -> None:
        """Have the next measurement sweep every tile."""
        self._listed = [kept.prepared.views.tiles for kept in self._kept]
        if self._kept:
            everything = np.concatenate([np.arange(count, dtype=np.uint32) for count in self._listed])
            with self.device.errors("failed while computing"):
                cl.enqueue_copy(self.device.queue, self._tiles, everything, is_blocking=True)
            self.device.fill(self._stale, np.float32(0))

    # --------------------------------------------------------------------------------------- views that are not kept

    def _unkept_are_stale(self) -> bool:
        """Whether they have lost more than the tolerance since they were measured: a part of their area, on average."""
        if not self._unkept_known or self._options.tolerance <= 0:
            return True
        words = self._words_lost
        self.device.fill(words, np.int64(0))
        lost = self.device.shared_kernel(_SOURCE, "lost", **totals_limits(self.device))
        lost.bind(states=self.marks, totals=self._totals_of_unkept, splats=self.splats, importance=words)
        lost.launch((-(-self.splats // _LOST_CHUNK) * _GROUP,), (_GROUP,))
        importance = int(self.device.download(words, (1,), np.int64)[0])
        part = sum(len(batch.numbers) for batch in self._unkept) / len(self._cameras)
        return importance * self.units[1] / part > _PATIENCE * self._options.tolerance

    def _measure_unkept(self) -> None:
        self.device.fill(self._totals_of_unkept, np.uint32(0))
        for batch in self._unkept:
            with self._swept(batch, self._totals_of_unkept):
                pass

    @contextmanager
    def _swept(self, batch: Batch, totals: cl.Buffer | None) -> Iterator[Ready | None]:
        """Some views prepared and swept, and added to totals (N, 2); None if none of their splats is left."""
        target, stored = batch.targets, batch.known
        if target is None:
            scratch, stored = self._scratch[-1], False
            scratch.reserve(_PIXEL * sum(self._cameras[k].width * self._cameras[k].height for k in batch.numbers))
            target = scratch.buffer
        if not stored and not self._pristine:
            with self._ready(batch, target, whole=True) as views:
                assert views is not None
                views.kernels.store_target()
                self._finish()
            stored = True
        with self._ready(batch, target, totals) as views:
            if views is not None:
                if stored:
                    views.kernels.target_is_known()
                views.kernels.sweep(0, views.prepared.views.tiles)
                self._finish()
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
        device, cameras = self.device, [self._cameras[number] for number in batch.numbers]
        unwanted, tiles, stale, _ = self._scratch
        with ExitStack() as stack:
            stack.callback(self._passing.close)
            states = None if whole else self.marks
            numbers, splats = self._picker.pick(self._passing, batch.wanted, states, SplatState.ALIVE)
            if not splats:
                yield None
                return
            rasterizer = stack.enter_context(self._rasterizer(numbers, splats, former=whole))
            views = rasterizer.prepare_set(cameras, self._passing)
            prepared = PreparedSet(rasterizer, range(len(cameras)), views, self._passing, target)
            stack.enter_context(prepared)
            stale.reserve(4 * views.tiles)
            if tiles.reserve(4 * views.tiles):  # all of them: nobody writes to it
                everything = np.arange(views.tiles, dtype=np.uint32)
                with device.errors("failed while computing"):
                    cl.enqueue_copy(device.queue, tiles.buffer, everything, is_blocking=True)
            if totals is None:
                unwanted.reserve(16 * rasterizer.stride)
            # The states are not looked at: what has gone is not among the splats.
            wanted = (unwanted.buffer, None) if totals is None else (totals, numbers)
            buffers = SweepBuffers(self.marks, tiles.buffer, stale.buffer, self._counts, *wanted)
            launcher = launcher_for(rasterizer, self._options, self._fixed_point)
            kernels = launcher.bind(prepared, (views.shapes, views.colours), buffers, first_time=True)
            yield Ready(prepared, numbers, splats, kernels)

    def _finish(self) -> None:
        with self.device.errors("failed while computing"):
            self.device.queue.finish()

    # ----------------------------------------------------------------------------------- for a controller on the host

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        return self._fixed_point.values(self.measure_totals())

    def measure_totals(self) -> NDArray[np.int64]:
        """The same as (N, 2) int64 in units of the fixed point: the sums over the views that are measured here."""
        self.measure_on_device()
        return self.device.download(self.totals, (self.splats, 2), np.int64)

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        self._survivors.remove(splats)
        self._list_stale(self._options.tolerance)
        self._pristine = False

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        self._sweep_listed()
        former, self._sh = self._sh, self._whole.other_sh(self._memory, sh)
        self._pristine = self._unkept_known = False
        for kept in self._kept:
            kept.rasterizer.project(kept.prepared.views, self._sh)
            self._finish()
            kept.rasterizer.rest()
        if former is not None:
            self._memory.free(former)
        self.sweep_everything()

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self._list_everything()
        self._unkept_known = False

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """See :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances`."""
        self.sweep_changed()
        yield from self.known_importances()

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured, in the views that are kept."""
        self._list_stale(0.0)
        self._sweep_listed()

    def known_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` of the views that are measured here, right after :meth:`sweep_changed`."""
        alive = self.alive
        kept = {each.view.number: each for each in self._kept}
        unkept = {number for batch in self._unkept for number in batch.numbers}
        for number in sorted([*kept, *unkept]):
            if number in kept:
                view = kept[number].view
                yield self._importances(number, kept[number].prepared, view.numbers, view.splats, alive)
                continue
            with self._swept(Batch([number], self._seen[number]), None) as ready:
                if ready is None:
                    yield number, np.zeros(0, np.int64), np.zeros(0)
                else:
                    yield self._importances(number, ready.prepared, ready.numbers, ready.splats, alive)

    def _importances(
        self, number: int, prepared: PreparedSet, numbers: cl.Buffer, splats: int, alive: NDArray[np.bool_]
    ) -> tuple[int, Indices, F64]:
        named = self.device.download(numbers, (splats,), np.uint32).astype(np.int64)
        ((_, _, intersections, sums),) = prepared.read_sums()
        weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
        total = np.bincount(intersections, weights=weights, minlength=splats)
        seen = np.flatnonzero((total > 0) & alive[named])
        camera = self._cameras[number]
        return number, named[seen], total[seen] / (camera.width * camera.height)

    def _close_kept(self) -> None:
        for kept in self._kept:
            kept.close()
        self._kept = []

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
