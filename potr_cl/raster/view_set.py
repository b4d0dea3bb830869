"""Views on a device: their cameras as the kernels take them, and the buffers that the rasterizer's stages fill."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError, UsageError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.opencl.structs import struct_dtype

#: Pixels along a side of a tile.
TILE = 16

#: Tiles along a side of the image: the kernels number them in 16 bits.
_MOST_TILES = 0xFFFF

#: ``View`` of the kernels, and ``SetView``, which has one.
_CAMERA = struct_dtype("include/splat.clh", "View")
_SET_VIEW = struct_dtype("include/view_set.clh", "SetView")
#: Bytes of a view in a set's table.
TABLE_ENTRY = _SET_VIEW.itemsize


class ViewSet(Owner):
    """Views whose parts of the buffers lie one after another, so that one launch can do all views.

    Made by :meth:`potr_cl.raster.rasterizer.Rasterizer.prepare_set`.

    Args:
        device: that the buffers lie on.
        cameras: whose views they are.
        stride: splats of the scene, padded.
        subtile_bytes: of an element of ``subtiles``.
        memory: to take the buffers from, which is closed with the views; None: memory of their own.

    Attributes:
        views: each with the parts of the buffers that are its own.
        stride: as given.
        tiles, pixels: of all views.
        capacity: room for intersections, of all views.
        intersection_starts: where each view's intersections begin, and their end.
        found_offsets: each view's ``offsets`` on the host, as they were when its lists were prepared.
        table: where each view's part begins, ``SetView`` in cl/include/view_set.clh.
        shapes: (views, N, 8) float32, a splat's ellipse, see cl/include/splat.clh.
        colours: (views, N, 4) float32; R, G, B of the splats that are drawn, the rest unset.
        offsets: (columns * rows + 1,) uint32 of each view, where each tile's run of ``intersections`` begins.
        intersections: (capacity,) uint32 splat numbers, tile by tile, front to back within a tile.
        subtiles: (capacity,), a bit for each sub-tile of its tile that an intersection touches
            (cl/include/subtiles.clh), uint32 for CPU kernels, uint16 for GPU kernels.

    Raises:
        UsageError: an image is too large.
        DeviceMemoryError: the device has no room for the buffers.
    """

    shapes: cl.Buffer
    colours: cl.Buffer
    offsets: cl.Buffer
    intersections: cl.Buffer
    subtiles: cl.Buffer

    def __init__(
        self, device: Device, cameras: Sequence[Camera], stride: int, subtile_bytes: int, memory: Memory | None = None
    ) -> None:
        self._device = device
        self._memory = memory or Memory(device)
        self._subtile_bytes = subtile_bytes
        self.stride = stride
        self.views = [View(camera) for camera in cameras]
        self.tiles = sum(view.tiles for view in self.views)
        self.pixels = sum(view.pixels for view in self.views)
        self.capacity = 0
        self.found_offsets: list[NDArray[np.uint32]] = []
        self.intersection_starts = [0] * (len(cameras) + 1)
        self._offset_starts = [0, *itertools.accumulate(view.tiles + 1 for view in self.views)]
        try:
            self.shapes = self._memory.allocate(32 * stride * len(cameras), "the projected splats")
            self.colours = self._memory.allocate(16 * stride * len(cameras), "the projected splats' colours")
            self._geometry: tuple[cl.Buffer, ...] = (self.shapes, self.colours)
            self.offsets = self._memory.allocate(4 * self._offset_starts[-1], "the tile offsets")
            self.table = self._memory.allocate(_SET_VIEW.itemsize * len(cameras), "the views")
        except BaseException:
            self.close()
            raise
        self._write_table()

    def _write_table(self) -> None:
        table = np.zeros(len(self.views), _SET_VIEW)
        table["first_intersection"] = self.intersection_starts[:-1]
        table["first_offset"] = self._offset_starts[:-1]
        tile = pixel = 0
        for row, view in zip(table, self.views, strict=True):
            row["view"] = camera_struct(view.camera)
            row["first_tile"], row["first_pixel"] = tile, pixel
            tile += view.tiles
            pixel += view.pixels
        # Nobody waits for it: an event that is replaced lets go of its table when that is there.
        self._sent = cl.enqueue_copy(self._device.queue, self.table, table, is_blocking=False)

    def aim(self, cameras: Sequence[Camera]) -> bool:
        """Point the views at other cameras, if each has as many tiles across and down as the one before it.

        Returns:
            Whether all have.
        """
        if [(view.columns, view.rows) for view in self.views] != [tile_grid(camera) for camera in cameras]:
            return False
        for view, camera in zip(self.views, cameras, strict=True):
            view.camera = camera
        self.pixels = sum(view.pixels for view in self.views)
        self._write_table()
        return True

    def make_room(self, counts: Sequence[int]) -> None:
        """Make room for this many intersections of each view. Earlier intersections are lost."""
        if self.capacity:
            self._memory.free(self.intersections, self.subtiles)
            self.capacity = 0
        starts = [0, *itertools.accumulate(counts)]
        if max(starts[-1], self.pixels) > 0xFFFFFFFF:
            raise DeviceMemoryError(f"{len(counts)} views have more intersections or pixels than can be numbered")
        self.intersections = self._memory.allocate(4 * starts[-1], "the tile lists")
        self.subtiles = self._memory.allocate(self._subtile_bytes * starts[-1], "the intersections' sub-tiles")
        for view, count in zip(self.views, counts, strict=True):
            view.capacity = count
        self.intersection_starts, self.capacity = starts, starts[-1]
        if len(self.views) > 1:
            self._write_table()

    def read_offsets(self) -> list[NDArray[np.uint32]]:
        """Each view's ``offsets``, once the device has found them."""
        words = self._device.download(self.offsets, (self._offset_starts[-1],), np.uint32)
        return [words[start:stop] for start, stop in itertools.pairwise(self._offset_starts)]

    def read_counts(self) -> list[int]:
        """Each view's intersections, once the device has found them; 2^32 - 1 for more than that."""
        if len(self.views) > 1:
            return [int(offsets[-1]) for offsets in self.read_offsets()]
        last = np.empty(1, np.uint32)
        with self._device.errors("failed while computing"):
            cl.enqueue_copy(
                self._device.queue, last, self.offsets, src_offset=4 * self.views[0].tiles, is_blocking=True
            )
        return [int(last[0])]

    @property
    def nbytes(self) -> int:
        """Bytes of all."""
        return self._memory.nbytes

    @property
    def nbytes_cached(self) -> int:
        """Bytes of all but shapes and colours."""
        nbytes: int = self._memory.nbytes - sum(buffer.size for buffer in self._geometry)
        return nbytes

    def free_geometry(self) -> None:
        """Give the memory of shapes and colours back. :meth:`Rasterizer.project` can make them again elsewhere."""
        self._memory.free(*self._geometry)
        self._geometry = ()
        self.shapes = self.colours = None


class View:
    """One camera's part of a :class:`ViewSet`.

    Attributes:
        camera: whose view it is.
        columns, rows: tiles across and down.
        intersection_count: number of intersections; set once it is known that the device has found them all.
        capacity: number of intersections for which there is room.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.columns, self.rows = tile_grid(camera)
        if max(self.columns, self.rows) > _MOST_TILES:
            raise UsageError(
                f"view '{camera.name}': {camera.width} x {camera.height} pixels are more than {_MOST_TILES * TILE} "
                "on a side; render a smaller image"
            )
        self.intersection_count = self.capacity = 0

    @property
    def tiles(self) -> int:
        return self.columns * self.rows

    @property
    def pixels(self) -> int:
        return self.camera.width * self.camera.height


@lru_cache(maxsize=4096)
def camera_struct(camera: Camera) -> NDArray[Any]:
    """The camera as the kernels take it (``View`` in cl/include/splat.clh)."""
    struct = np.zeros((), _CAMERA)
    struct["rotation"] = camera.rotation.ravel()
    struct["camera_centre_high"] = camera.centre
    struct["camera_centre_low"] = camera.centre - struct["camera_centre_high"]
    struct["fx"], struct["fy"] = camera.fx, camera.fy
    struct["cx"], struct["cy"] = camera.cx, camera.cy
    struct["limit_x"] = 1.3 * camera.width / (2 * camera.fx)
    struct["limit_y"] = 1.3 * camera.height / (2 * camera.fy)
    struct["width"], struct["height"] = camera.width, camera.height
    struct["columns"], struct["rows"] = tile_grid(camera)
    return struct


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Columns and rows of tiles that cover the image."""
    return -(-camera.width // TILE), -(-camera.height // TILE)
