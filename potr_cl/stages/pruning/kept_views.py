"""Views of a large scene that stay prepared on a GPU, each with the splats that it may draw: :class:`KeptViews`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import partial

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.picked_splats import Picks
from potr_cl.raster.view_set import TILE
from potr_cl.stages.pruning.kept_view import KeptView, View
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.stages.pruning.queues import Queues
from potr_cl.stages.pruning.shrinking_scene import ShrinkingScene
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers

#: Bytes that a view is expected to take: of a splat (shape, colour, number, and two and a half tile intersections), and
#: of a pixel (the target).
SPLAT, PIXEL = 87, 12


def target_bytes(camera: Camera) -> int:
    """What the target picture of a view takes."""
    return PIXEL * camera.width * camera.height


def tiles_of(camera: Camera) -> int:
    """How many tiles a view has."""
    return -(-camera.width // TILE) * -(-camera.height // TILE)


class KeptViews(Owner):
    """Views that are prepared once. A measurement sweeps those of their tiles that have lost enough since the last one.

    Args:
        scene: that they look at.
        tiles: of all views that may be kept.
        views: how many these are.
        totals: (N, 2) int64 that their effects are added to.
        queues: that views are swept on, several at a time.

    Attributes:
        listed: (views,) uint32 in the device's memory, how many tiles of each view are listed.

    Raises:
        DeviceError: the device has no room for what all views share.
    """

    def __init__(self, scene: ShrinkingScene, tiles: int, views: int, totals: cl.Buffer, queues: Queues) -> None:
        self._scene, self._totals, self._queues = scene, totals, queues
        self._views: list[KeptView] = []
        self._pending: list[cl.Event] = []
        self._first_tile = 0
        #: Tiles of each view that the next measurement sweeps.
        self._to_sweep: list[int] = []
        self._targets_known = False
        self._memory = Memory(scene.device)
        with scene.device.all_or_nothing():
            self._stale = self._memory.upload(np.zeros(tiles, np.float32), "the tiles' staleness")
            self._tiles = self._memory.allocate(4 * tiles, "the tiles to sweep")
            self.listed = self._memory.allocate(4 * views, "the numbers of tiles to sweep")

    def __len__(self) -> int:
        return len(self._views)

    def __iter__(self) -> Iterator[KeptView]:
        return iter(self._views)

    def keep(self, number: int, camera: Camera, picks: Picks, room: int) -> int:
        """Prepare a view, and keep it if it takes no more than the room; returns the bytes that it takes, or 0."""
        device, splats = self._scene.device, picks.counts[number]
        if 2 / 3 * SPLAT * splats + target_bytes(camera) > room:
            return 0
        before = device.allocated
        with suppress(DeviceMemoryError), ExitStack() as stack:
            memory = stack.enter_context(Memory(device))
            view = View(number, camera, splats, picks.numbers(memory, number))
            rasterizer = stack.enter_context(self._scene.rasterizer(view.numbers, splats))
            views = rasterizer.prepare_set([camera])
            # The device sorts its lists while the next view is made ready.
            prepared = PreparedSet(rasterizer, range(number, number + 1), views, pending=self._pending)
            stack.enter_context(prepared)
            rasterizer.rest()
            taken = device.allocated - before
            if taken > room:
                return 0
            prepared.first_tile = self._first_tile
            marks = self._scene.survivors.buffer
            buffers = SweepBuffers(marks, self._tiles, self._stale, self.listed, self._totals, view.numbers)
            kernels = self._scene.launcher(rasterizer).bind(
                prepared,
                (prepared.views.shapes, prepared.views.colours),
                buffers,
                first_time=True,
                place=len(self._views),
            )
            self._views.append(KeptView(view, prepared, memory, rasterizer, kernels))
            self._first_tile += tiles_of(camera)
            stack.pop_all()
            return taken
        return 0

    def ready(self) -> None:
        """Wait until all views that are kept are prepared, and list all their tiles."""
        self.list_everything()
        self._scene.finish()
        self._pending.clear()

    def sweep_listed(self) -> None:
        """Measure the tiles that are listed."""
        work = [(count, kept) for count, kept in zip(self._to_sweep, self._views, strict=True) if count]
        # The longest first, so that nothing long begins at the end.
        work.sort(key=lambda each: -each[0])
        self._queues.enqueue([partial(kept.sweep, count) for count, kept in work])
        self._queues.wait()
        self._to_sweep = [0] * len(self._views)
        if not self._targets_known:
            for kept in self._views:
                kept.target_is_known()
            self._targets_known = True

    def list_stale(self, tolerance: float) -> None:
        """Have all views note what has gone, and list the tiles that are staler than the tolerance."""
        self.sweep_listed()
        self._scene.device.fill(self.listed, np.uint32(0))
        self._queues.enqueue([partial(kept.note_removal, tolerance) for kept in self._views])
        self._queues.wait()
        self._to_sweep = self._scene.device.download(self.listed, (len(self._views),), np.uint32).tolist()

    def list_everything(self) -> None:
        """Have the next measurement sweep every tile."""
        self._to_sweep = [kept.prepared.views.tiles for kept in self._views]
        if self._views:
            everything = np.concatenate([np.arange(count, dtype=np.uint32) for count in self._to_sweep])
            with self._scene.device.errors("failed while computing"):
                cl.enqueue_copy(self._scene.device.queue, self._tiles, everything, is_blocking=True)
            self._scene.device.fill(self._stale, np.float32(0))

    def replace_sh(self, sh: FloatArray) -> None:
        """Give the scene other SH coefficients, and project all views again with them."""
        self.sweep_listed()
        now, former = self._scene.replace_sh(sh)
        for kept in self._views:
            kept.rasterizer.project(kept.prepared.views, now)
            self._scene.finish()
            kept.rasterizer.rest()
        self._scene.free(former)

    def close(self) -> None:
        for kept in self._views:
            kept.close()
        self._views = []
        self._memory.close()
