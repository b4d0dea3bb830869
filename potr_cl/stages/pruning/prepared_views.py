"""Views prepared for removal sweeps, and which of them the memory budget lets stay prepared.

A view's projection, tile lists and depth order do not depend on which splats are left: pruning only takes intersections
out. So they are made once and cached; a view that does not fit the budget is prepared again for each sweep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_cache import ViewCache
from potr_cl.raster.view_set import TILE, View, ViewSet


class PreparedViews(Owner):
    """All views of a removal sweep.

    Args:
        rasterizer: that prepares them.
        cameras: of the views.
        budget: bytes that the cached views may take.
        most: views that may be swept in one launch.
        progress: called with the views prepared and their number.

    Attributes:
        rasterizer: as given.
        cached: sets of views whose lists fit the budget.
        uncached: numbers of the views that are prepared again for each sweep, in groups that are prepared together.
        cached_tiles: tiles of the cached views. tiles: of all views.

    Raises:
        DeviceMemoryError: a view alone does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        budget: float,
        most: int,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.rasterizer = rasterizer
        self._cameras = list(cameras)
        self._cache = ViewCache(rasterizer, budget)
        self.cached: list[PreparedSet] = []
        self.uncached: list[range] = []
        self.cached_tiles = 0
        self.tiles = sum(-(-c.width // TILE) * -(-c.height // TILE) for c in cameras)
        try:
            self._prepare_all(most, progress)
        except BaseException:
            self.close()
            raise

    @property
    def cached_view_tiles(self) -> list[tuple[int, int]]:
        """(number among the cameras, tiles) of each cached view, in the order in which their tiles are numbered."""
        return [
            (number, view.tiles)
            for prepared in self.cached
            for number, view in zip(prepared.numbers, prepared.views.views, strict=True)
        ]

    @property
    def geometry_is_shared(self) -> bool:
        """Whether some cached sets have no projection of their own and are projected again for each launch."""
        return self._cache.shared is not None

    def geometry(self, prepared: PreparedSet) -> tuple[cl.Buffer, cl.Buffer]:
        """Shapes and colours of a set: its own, or those that it shares with others."""
        views = prepared.views
        if views.shapes is None and self._cache.shared is not None:
            return self._cache.shared
        return views.shapes, views.colours

    def project(self, prepared: PreparedSet) -> None:
        """Enqueue a set's projection, if it has none of its own."""
        if prepared.views.shapes is None:
            self.rasterizer.project(prepared.views, None, *self.geometry(prepared))

    def prepare(self, numbers: range) -> PreparedSet:
        """Prepare the views of these numbers; all their sums are 0.

        Returns:
            The views; the caller closes them.

        Raises:
            DeviceMemoryError: they do not fit the device, or not all in buffers of the size that it allows.
        """
        views = self.rasterizer.prepare_set([self._cameras[number] for number in numbers])
        return PreparedSet(self.rasterizer, numbers, views)

    def _prepare_all(self, most: int, progress: Callable[[int, int], None] | None) -> None:
        """Prepare every view, and keep as many as the budget allows."""
        with self.rasterizer.preparing_many():
            self._prepare_in_turn(most, progress)

    def _prepare_in_turn(self, most: int, progress: Callable[[int, int], None] | None) -> None:
        number, count = 0, len(self._cameras)
        most = self._cache.most_views(most, 12 * max(c.width * c.height for c in self._cameras))
        while number < count:
            numbers = range(number, min(number + most, count))
            try:
                prepared = self.prepare(numbers)
            except DeviceMemoryError:
                if most == 1:
                    raise
                most //= 2
                continue
            self._keep(prepared)
            number = numbers.stop
            if progress is not None:
                progress(number, count)

    def _keep(self, prepared: PreparedSet) -> None:
        """Cache prepared views if the budget allows; else give their memory back."""
        try:
            fits = self._cache.keep(prepared.views, prepared.nbytes)
        except BaseException:
            prepared.close()
            raise
        if not fits:
            self.uncached.append(prepared.numbers)
            prepared.close()
            return
        prepared.first_tile = self.cached_tiles
        self.cached_tiles += prepared.views.tiles
        self.cached.append(prepared)

    def close(self) -> None:
        """Give all device memory back."""
        for prepared in self.cached:
            prepared.close()
        self.cached = []
        self._cache.close()


class PreparedSet(Owner):
    """Views that are swept in one launch, and what is kept of them from sweep to sweep.

    Args:
        rasterizer: that prepared them.
        numbers: of the views among the cameras.
        views: projection and lists, as they were prepared for the first time; this object's from now on.
        memory: to take the rest from, which is closed with this object; None: memory of its own.
        target: the pictures before any removal, which stay the caller's; None: memory for them.
        pending: as of :meth:`potr_cl.opencl.device.Device.upload`.

    Attributes:
        numbers, views: as given.
        lengths: (tiles,) uint32, intersections that a tile has left.
        sums: (intersections, 2) float32, ΔMSE and I of an intersection, summed over its tile's pixels.
        target: (pixels, 3) float32, the pictures before any removal.
        first_tile: where the tiles begin among those of all cached views.

    Raises:
        DeviceMemoryError: the device has no room.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        numbers: range,
        views: ViewSet,
        memory: Memory | None = None,
        target: cl.Buffer | None = None,
        pending: list[cl.Event] | None = None,
    ) -> None:
        self._device = device = rasterizer.device
        self._memory = memory or Memory(device)
        self.numbers, self.views = numbers, views
        self.first_tile = 0
        try:
            lengths = np.concatenate([np.diff(offsets) for offsets in views.found_offsets])
            views.found_offsets = []
            self.lengths = self._memory.upload(lengths, "the tile lists", pending)
            self.sums = self._memory.allocate(8 * views.capacity, "the tiles' removal effects")
            self.target = target or self._memory.allocate(12 * views.pixels, "the target images")
        except BaseException:
            self.close()
            raise
        self.zero_sums()

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept besides projection and lists."""
        return self._memory.nbytes

    def zero_sums(self) -> None:
        """Enqueue that all sums become 0, as before the first sweep."""
        self._device.fill(self.sums, np.float32(0))

    def read_sums(self) -> Iterator[tuple[int, View, NDArray[np.uint32], NDArray[np.float32]]]:
        """What the last sweep left, view by view.

        Yields:
            The number of the view among the cameras, the view, the splat of each of its intersections, (intersections,)
            uint32, and their sums, (intersections, 2) float32.

        Raises:
            DeviceError: the device failed.
        """
        views = self.views
        for number, view, start in zip(self.numbers, views.views, views.intersection_starts, strict=False):
            intersections = np.empty(view.intersection_count, np.uint32)
            sums = np.empty((view.intersection_count, 2), np.float32)
            if view.intersection_count:
                with self._device.errors("failed while computing"):
                    for array, buffer in ((intersections, views.intersections), (sums, self.sums)):
                        offset = start * array[0].nbytes
                        cl.enqueue_copy(self._device.queue, array, buffer, src_offset=offset, is_blocking=True)
            yield number, view, intersections, sums

    def close(self) -> None:
        """Give the memory back, including that of the views."""
        self.views.close()
        self._memory.close()
