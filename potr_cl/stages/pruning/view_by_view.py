"""Removal effects of large scenes on a GPU, each view with the splats that it may draw: :class:`ViewByView`.

Of a large scene no view sees much. The whole scene lies on the device once; a view has its own numbers of splats, and
its projection, lists and totals are of these and no others. Totals are added up by the scene's numbers. They are
integers in units that follow from all views, so they are the same bits as of all views with all splats.

Views that the memory has no room for are prepared again whenever they are measured. They are measured together, and
only when they have lost more since the last time, on the average, than a tile may lose before it is swept again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.raster.culling import Sights
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.picked_splats import PickedSplats, Picker
from potr_cl.raster.rasterizer import PreparingMemory, Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.raster.view_set import TILE
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.launcher import SetKernels, launcher_for
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.stages.pruning.queues import Queues
from potr_cl.stages.pruning.removal import F64, Indices
from potr_cl.stages.pruning.survivors import SplatState
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers
from potr_cl.stages.pruning.sweep_options import SweepOptions, default_memory

_SOURCE = "prune/parts.cl"
_GROUP = 64
#: Splats that a work-group of the kernel `lost` looks at.
_LOST_CHUNK = 4096
#: Views that are swept at the same time: the longest list of one keeps a work-group busy when the others are done.
_QUEUES = 8
#: Bytes that a view takes at least: of a splat (shape, colour, totals, state, number) and of a pixel (the target). And
#: what making one takes besides, of a splat.
_SPLAT, _PIXEL, _MAKING = 69, 12, 120


@dataclass(frozen=True)
class _View:
    """A view, and what it may draw.

    Attributes:
        number: among all views.
        camera: of the view.
        splats: how many it may draw.
        numbers: of these in the scene, uint32, ascending, in the device's memory.
    """

    number: int
    camera: Camera
    splats: int
    numbers: cl.Buffer

    @property
    def items(self) -> tuple[int]:
        """Work-items for a kernel that does a splat each."""
        return (-(-self.splats // _GROUP) * _GROUP,)


class _KeptView(Owner):
    """A view that stays prepared.

    Args:
        view: which one.
        prepared: its lists and sums; this object's from now on.
        memory: that owns what else it takes; this object's from now on.
        rasterizer: that prepared it.
        marks: (splats,) the states of its splats. totals: (splats, 2) int64.
    """

    def __init__(
        self,
        view: _View,
        prepared: PreparedSet,
        memory: Memory,
        rasterizer: Rasterizer,
        marks: cl.Buffer,
        totals: cl.Buffer,
    ) -> None:
        self.view, self.prepared, self.rasterizer = view, prepared, rasterizer
        self.marks, self.totals = marks, totals
        self._memory = memory
        self._kernels: SetKernels
        self._add: Kernel
        self._mark: Kernel

    def bind(self, kernels: SetKernels, add: Kernel, mark: Kernel) -> None:
        """Give it its kernels, all arguments bound."""
        self._kernels, self._add, self._mark = kernels, add, mark

    def sweep(self, count: int, queue: cl.CommandQueue) -> None:
        """Enqueue the sweep of the first tiles of its list."""
        self._kernels.sweep(self.prepared.first_tile, count, queue)

    def target_is_known(self) -> None:
        """From now on, sweeps compare with the target picture."""
        self._kernels.target_is_known()

    def add(self) -> None:
        """Enqueue that its totals are added to the scene's."""
        self._add.launch(self.view.items, (_GROUP,))

    def note_removal(self, tolerance: float, queue: cl.CommandQueue) -> None:
        """Enqueue that it notes which splats have gone, and lists the tiles that are staler than the tolerance."""
        self._mark.launch(self.view.items, (_GROUP,), queue)
        self._kernels.note_removal(queue, list_above=tolerance)

    def close(self) -> None:
        self.prepared.close()
        self._memory.close()
        self.rasterizer.close()


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
    ) -> None:
        self.device, self.splats = device, whole.splats
        self._whole, self._cameras, self._options, self._background = whole, cameras, options, background
        self._fixed_point = FixedPoint.of_views(cameras)
        self.units = self._fixed_point.units
        self._queues = Queues(device, _QUEUES)
        self._sh: cl.Buffer | None = None  # other coefficients than those of the targets
        self._kept: list[_KeptView] = []
        self._unkept: list[_View] = []
        #: Tiles of each kept view that the next measurement sweeps.
        self._listed: list[int] = []
        #: Whether every splat is left, and has the colours of the targets.
        self._pristine = True
        self._targets_known = self._unkept_known = False
        with ExitStack() as owned:
            self._memory = memory = owned.enter_context(Memory(device))
            owned.callback(self._close_kept)
            self._scratch = [
                owned.enter_context(Scratch(device, what))
                for what in ("a view's effects", "a view's splats that are left", "a view's tiles", "their staleness")
            ]
            self._preparing = owned.enter_context(PreparingMemory(device))
            self.totals = memory.allocate(16 * whole.stride, "the removal effects")
            self._first: cl.Buffer | None = None
            if first_totals is not None:
                self._first = memory.upload(first_totals, "the removal effects to begin with")
            self.marks = memory.upload(np.full(whole.stride, SplatState.ALIVE, np.uint8), "the splats that are left")
            self._prepare_all(sights, progress)
            self._owned = owned.pop_all()
        self.kept_views = len(self._kept)

    @property
    def steering(self) -> ViewByView:
        """Itself: the device chooses."""
        return self

    # --------------------------------------------------------------------------------------------- preparing views

    def _prepare_all(self, sights: Sights, progress: Callable[[int, int], None] | None) -> None:
        device, memory = self.device, self._memory
        most = max(camera.width * camera.height for camera in self._cameras)
        budget = default_memory(device) if self._options.memory is None else self._options.memory
        totals = sights.totals
        # What views take that are not kept, and what making one of them takes.
        left = budget - 4 * int(totals.sum()) - _MAKING * int(totals.max()) - _PIXEL * most
        tiles = [-(-camera.width // TILE) * -(-camera.height // TILE) for camera in self._cameras]
        self._stale = memory.upload(np.zeros(sum(tiles), np.float32), "the tiles' staleness")
        self._tiles = memory.allocate(4 * sum(tiles), "the tiles to sweep")
        self._counts = memory.allocate(4 * len(tiles), "the numbers of tiles to sweep")
        first_tile = 0
        with Picker(device, sights.groups.group_of) as picker:
            for number, camera in enumerate(self._cameras):
                if totals[number]:
                    numbers, count = picker.pick(memory, sights.seen[number])
                    view = _View(number, camera, count, numbers)
                    kept = self._keep(view, left, first_tile)
                    if kept:
                        left -= kept
                        first_tile += tiles[number]
                    else:
                        self._unkept.append(view)
                if progress is not None:
                    progress(number + 1, len(self._cameras))
        self._list_everything()
        if self._unkept:
            self._totals_of_unkept = memory.allocate(16 * self._whole.stride, "the effects in views that are not kept")

    def _keep(self, view: _View, room: float, first_tile: int) -> int:
        """Prepare a view, and keep it if it takes no more than the room; returns the bytes that it takes, or 0."""
        device = self.device
        if _SPLAT * view.splats + _PIXEL * view.camera.width * view.camera.height > room:
            return 0
        before = device.allocated
        with suppress(DeviceMemoryError), ExitStack() as stack:
            rasterizer = stack.enter_context(self._rasterizer(view))
            prepared = stack.enter_context(self._prepared(view, rasterizer))
            rasterizer.rest()
            memory = stack.enter_context(Memory(device))
            marks = memory.allocate(rasterizer.stride, "a view's splats that are left")
            totals = memory.allocate(16 * rasterizer.stride, "a view's removal effects")
            taken = device.allocated - before
            if taken > room:
                return 0
            device.fill(marks, np.uint8(SplatState.ALIVE))
            device.fill(totals, np.uint32(0))
            prepared.first_tile = first_tile
            kept = _KeptView(view, prepared, memory, rasterizer, marks, totals)
            buffers = SweepBuffers(marks, self._tiles, self._stale, self._counts, totals)
            kernels = launcher_for(rasterizer, self._options, self._fixed_point).bind(
                prepared,
                (prepared.views.shapes, prepared.views.colours),
                buffers,
                first_time=True,
                place=len(self._kept),
            )
            kept.bind(kernels, self._add(view, self.totals, totals), self._mark(view, marks))
            self._kept.append(kept)
            stack.pop_all()
            return taken
        return 0

    def _rasterizer(self, view: _View) -> Rasterizer:
        picked = PickedSplats(self._whole, view.numbers, view.splats)
        if self._sh is not None:
            picked.sh = self._sh
        return Rasterizer(self.device, picked, background=self._background, preparing=self._preparing)

    def _prepared(self, view: _View, rasterizer: Rasterizer) -> PreparedSet:
        views = rasterizer.prepare_set([view.camera])
        return PreparedSet(rasterizer, range(view.number, view.number + 1), views)

    def _add(self, view: _View, totals: cl.Buffer, part: cl.Buffer) -> Kernel:
        kernel = self._kernel("add_part")
        return kernel.bind(totals=totals, part=part, numbers=view.numbers, count=view.splats)

    def _mark(self, view: _View, marks: cl.Buffer) -> Kernel:
        kernel = self._kernel("mark_part")
        return kernel.bind(states=self.marks, part=marks, numbers=view.numbers, count=view.splats)

    def _kernel(self, name: str) -> Kernel:
        return self.device.kernel(_SOURCE, name, **totals_limits(self.device))

    # ------------------------------------------------------------------------------ for a controller on the device

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        alive: NDArray[np.bool_] = self.device.download(self.marks, (self.splats,), np.uint8) == SplatState.ALIVE
        return alive

    def measure_on_device(self) -> None:
        """Bring the totals up to date."""
        self._sweep_listed()
        if self._first is None:
            self.device.fill(self.totals, np.int64(0))
        else:
            with self.device.errors("failed while computing"):
                cl.enqueue_copy(self.device.queue, self.totals, self._first, byte_count=16 * self.splats)
        for kept in self._kept:
            kept.add()
        if self._unkept:
            if self._unkept_are_stale():
                self._measure_unkept()
                self._unkept_known = True
            add = self.device.shared_kernel("prune/add_totals.cl", "add_totals")
            add.bind(totals=self.totals, more=self._totals_of_unkept, count=2 * self.splats)
            add.launch((-(-2 * self.splats // _GROUP) * _GROUP,), (_GROUP,))

    def remove_marked(self) -> None:
        """Take the splats out that are marked JUST_REMOVED."""
        self._list_stale(self._options.tolerance)
        self._pristine = False

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
            cl.enqueue_copy(self.device.queue, self._tiles, everything, is_blocking=True)
            self.device.fill(self._stale, np.float32(0))

    # --------------------------------------------------------------------------------------- views that are not kept

    def _unkept_are_stale(self) -> bool:
        """Whether they have lost more than the tolerance since they were measured: a part of their area, on average."""
        if not self._unkept_known or self._options.tolerance <= 0:
            return True
        with Memory(self.device) as memory:
            words = memory.upload(np.zeros(1, np.int64), "the importance that has gone")
            lost = self._kernel("lost").bind(
                states=self.marks, totals=self._totals_of_unkept, splats=self.splats, importance=words
            )
            lost.launch((-(-self.splats // _LOST_CHUNK) * _GROUP,), (_GROUP,))
            importance = int(self.device.download(words, (1,), np.int64)[0])
        return importance * self.units[1] * len(self._cameras) / len(self._unkept) > self._options.tolerance

    def _measure_unkept(self) -> None:
        self.device.fill(self._totals_of_unkept, np.uint32(0))
        for view in self._unkept:
            with self._swept(view, self._totals_of_unkept):
                pass

    def _swept(self, view: _View, totals: cl.Buffer | None) -> PreparedSet:
        """A view prepared and swept, its totals added to others; the caller closes it."""
        device = self.device
        own_totals, marks, tiles, stale = self._scratch
        with self._rasterizer(view) as rasterizer:
            stride = rasterizer.stride
            own_totals.reserve(16 * stride)
            marks.reserve(stride)
            prepared = self._prepared(view, rasterizer)
            try:
                count = prepared.views.tiles
                tiles.reserve(4 * count)
                stale.reserve(4 * count)
                numbers = np.arange(count, dtype=np.uint32)
                cl.enqueue_copy(device.queue, tiles.buffer, numbers, is_blocking=True)
                buffers = SweepBuffers(marks.buffer, tiles.buffer, stale.buffer, self._counts, own_totals.buffer)
                launcher = launcher_for(rasterizer, self._options, self._fixed_point)
                geometry = (prepared.views.shapes, prepared.views.colours)
                prepared.first_tile = 0
                kernels = launcher.bind(prepared, geometry, buffers, first_time=True)
                if not self._pristine:
                    if self._sh is not None:
                        rasterizer.project(prepared.views, self._whole.sh)
                    device.fill(marks.buffer, np.uint8(SplatState.ALIVE), stride)
                    kernels.store_target()
                    prepared.zero_sums()
                    if self._sh is not None:
                        rasterizer.project(prepared.views)
                device.fill(own_totals.buffer, np.uint32(0), 16 * stride)
                self._mark(view, marks.buffer).launch(view.items, (_GROUP,))
                kernels.sweep_all()
                if totals is not None:
                    self._add(view, totals, own_totals.buffer).launch(view.items, (_GROUP,))
                with device.errors("failed while computing"):
                    device.queue.finish()
            except BaseException:
                prepared.close()
                raise
        return prepared

    # ----------------------------------------------------------------------------------- for a controller on the host

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        self.measure_on_device()
        return self._fixed_point.values(self.device.download(self.totals, (self.splats, 2), np.int64))

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        states = self.device.download(self.marks, (self._whole.stride,), np.uint8)
        states[states == SplatState.JUST_REMOVED] = SplatState.REMOVED
        states[splats] = SplatState.JUST_REMOVED
        cl.enqueue_copy(self.device.queue, self.marks, states, is_blocking=True)
        self.remove_marked()

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        self._sweep_listed()
        former, self._sh = self._sh, self._whole.other_sh(self._memory, sh)
        self._pristine = self._unkept_known = False
        for kept in self._kept:
            kept.rasterizer.project(kept.prepared.views, self._sh)
            with self.device.errors("failed while computing"):
                self.device.queue.finish()
            kept.rasterizer.rest()
        if former is not None:
            self._memory.free(former)
        self._list_everything()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """See :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances`."""
        self._list_stale(0.0)
        self._sweep_listed()
        alive = self.alive
        kept = {each.view.number: each for each in self._kept}
        views = sorted([*self._unkept, *(each.view for each in self._kept)], key=lambda view: view.number)
        for view in views:
            if view.number in kept:
                yield self._importances(view, kept[view.number].prepared, alive)
            else:
                with self._swept(view, None) as prepared:
                    yield self._importances(view, prepared, alive)

    def _importances(self, view: _View, prepared: PreparedSet, alive: NDArray[np.bool_]) -> tuple[int, Indices, F64]:
        numbers = self.device.download(view.numbers, (view.splats,), np.uint32).astype(np.int64)
        ((_, _, intersections, sums),) = prepared.read_sums()
        weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
        total = np.bincount(intersections, weights=weights, minlength=view.splats)
        seen = np.flatnonzero((total > 0) & alive[numbers])
        return view.number, numbers[seen], total[seen] / (view.camera.width * view.camera.height)

    def _close_kept(self) -> None:
        for kept in self._kept:
            kept.close()
        self._kept = []

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
