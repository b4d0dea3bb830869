"""Views that are swept in one launch, and what is kept of them from sweep to sweep: :class:`PreparedSet`.

A view's projection, tile lists and depth order do not depend on which splats are left: pruning only takes intersections
out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import View, ViewSet


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
        first_tile: where the tiles begin among those of all resident views.

    Raises:
        DeviceMemoryError: the device has no room.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        numbers: Sequence[int],
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

    def read_sums(self, place: int) -> tuple[View, NDArray[np.uint32], NDArray[np.float32]]:
        """What the last sweep left of one of the views.

        Returns:
            The view, the splat of each of its intersections, (intersections,) uint32, and their sums, (intersections,
            2) float32.

        Raises:
            DeviceError: the device failed.
        """
        view, start = self.views.views[place], self.views.intersection_starts[place]
        intersections = np.empty(view.intersection_count, np.uint32)
        sums = np.empty((view.intersection_count, 2), np.float32)
        if view.intersection_count:
            with self._device.errors("failed while computing"):
                for array, buffer in ((intersections, self.views.intersections), (sums, self.sums)):
                    offset = start * array[0].nbytes
                    cl.enqueue_copy(self._device.queue, array, buffer, src_offset=offset, is_blocking=True)
        return view, intersections, sums

    def close(self) -> None:
        """Give the memory back, including that of the views."""
        self.views.close()
        self._memory.close()
