"""Views are made ready to be composited: projection, tile lists and depth order (:class:`Preparation`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pyopencl as cl

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.launcher import RasterLauncher
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.projection import Projection
from potr_cl.raster.view_set import View, ViewSet


class Preparation(Owner):
    """Prepares views of one scene.

    Args:
        device: that computes.
        stride: N rounded up, as the scene on the device has it.
        projection: of the scene's splats.
        launcher: of the other steps.
        memory: to prepare views in, which stays the caller's; None: its own.

    Attributes:
        memory: that views are prepared in.
        shares: whether it stays the caller's.
    """

    def __init__(
        self,
        device: Device,
        stride: int,
        projection: Projection,
        launcher: RasterLauncher,
        memory: PreparingMemory | None,
    ) -> None:
        self._device, self._stride, self._projection, self._launcher = device, stride, projection, launcher
        self.memory, self.shares = memory or PreparingMemory(device), memory is not None
        #: Whether the memory that sets are prepared in is kept for now, and whether it is that of several views.
        self._keeps = self._prepared_several = False

    def new_views(self, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        """Views with nothing in them yet, and without room for intersections."""
        return ViewSet(self._device, cameras, self._stride, self._launcher.subtile_bytes, memory)

    def prepare_set(self, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        """See :meth:`potr_cl.raster.rasterizer.Rasterizer.prepare_set`."""
        views = self.new_views(cameras, memory)
        try:
            with self.counting():
                self._enqueue_offsets(views)
                # All of them, while there is nothing else to wait for: the lists are enqueued behind them.
                views.found_offsets = views.read_offsets()
                found = _accepted(views, [int(offsets[-1]) for offsets in views.found_offsets])
                views.make_room(found)
                self._enqueue_lists(views, for_frame=False, known=True)
        except BaseException:
            if len(cameras) > 1:
                self._rest()
            views.close()
            raise
        if len(cameras) > 1:  # far more than a single view will need
            self._prepared_several = True
            if not self._keeps:
                self._rest()
        return views

    def prepare_again(self, views: ViewSet, cameras: Sequence[Camera]) -> bool:
        """See :meth:`potr_cl.raster.rasterizer.Rasterizer.prepare_again`."""
        if not views.aim_all(cameras):
            return False
        with self.counting():
            self._enqueue_offsets(views)
            found = _accepted(views, views.read_counts())
            if any(count > view.capacity for view, count in zip(views.views, found, strict=True)):
                views.make_room([count + count // 4 for count in found])
            self._enqueue_lists(views, for_frame=False)
        return True

    def enqueue_frame(self, views: ViewSet) -> None:
        """Enqueue all steps of views that have room, for one picture of each; inside :meth:`counting`.

        Lists that do not fit are cut short: so the kernels are safe, and :meth:`counted` says what would have fitted.
        """
        self._enqueue_offsets(views)
        self._enqueue_lists(views, for_frame=True)

    def counted(self, views: ViewSet) -> list[int]:
        """How many intersections each view has, once the device has found them.

        Raises:
            DeviceError: one has too many.
        """
        return _accepted(views, views.read_counts())

    @contextmanager
    def counting(self) -> Iterator[None]:
        """The tiles' counters are zero before each use and after it; given back here if an error comes between."""
        try:
            yield
        except BaseException:
            self.memory.counts.close()
            raise

    @contextmanager
    def of_many_sets(self) -> Iterator[None]:
        """Inside the block, memory that sets are prepared in is kept for the next one: drivers take long to give it."""
        self._keeps = True
        try:
            yield
        finally:
            self._keeps = False
            if self._prepared_several:
                self._rest()

    def room_for_bounds(self, views: ViewSet) -> cl.Buffer:
        """Memory for what the projection of views leaves for the steps behind it."""
        self.memory.bounds.reserve(8 * self._stride * len(views.views))
        return self.memory.bounds.buffer

    def _enqueue_offsets(self, views: ViewSet) -> None:
        counts = self.memory.zeroed_counts(self._launcher.counter_bytes * views.tiles)
        bounds = self.room_for_bounds(views)
        self._projection.enqueue(views, bounds)
        self._launcher.enqueue_offsets(views, bounds, counts)

    def _enqueue_lists(self, views: ViewSet, for_frame: bool, known: bool = False) -> None:
        """Enqueue what follows the offsets, which the host may know."""
        memory = self.memory
        memory.keys.reserve(self._launcher.key_bytes * views.capacity)
        some_are_long = known and self._launcher.whole_sets and memory.long_lists.find(views)
        self._launcher.enqueue_lists(
            views,
            memory.bounds.buffer,
            memory.counts.buffer,
            memory.keys.buffer,
            for_frame,
            memory.long_lists if some_are_long else None,
        )

    def _rest(self) -> None:
        self._prepared_several = False
        if not self.shares:
            self.memory.rest()

    def close(self) -> None:
        """Give the memory back, unless it is the caller's."""
        if not self.shares:
            self.memory.close()


def _accepted(views: ViewSet, found: list[int]) -> list[int]:
    """Note in the views how many intersections the device has found, and return that."""
    for view, count in zip(views.views, found, strict=True):
        _accept(view, count)
    return found


def _accept(view: View, count: int) -> None:
    if count == 0xFFFFFFFF:
        raise DeviceError(
            f"view '{view.camera.name}' needs more than 2^32 tile intersections: "
            "too many huge splats for this image size"
        )
    view.intersection_count = count
