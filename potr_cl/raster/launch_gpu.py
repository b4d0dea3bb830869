"""The rasterizer's stages on GPUs: all views of a set in one launch, one work-group a tile.

A view alone is composited by a kernel of its own (cl/raster/composite_frame_gpu.cl), which needs no sub-tiles.
"""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.long_lists import LONGEST, LongLists
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.view_set import ViewSet

#: Words from one tile's counter to the next: the memory system does one atomic operation at a time in 32 bytes.
_COUNTER_STRIDE = 8

#: Keys that are sorted in local memory: 16 KB, half of what every GPU has, so that two tiles are sorted at a time.
_SORT_CAPACITY = 2048

#: Work-items of a work-group: one view's in the scan, one tile's in the others.
_SCAN, _SORT, _SUBTILES, _COMPOSITE, _FRAME = 256, 256, 128, 128, 256


class GpuLauncher:
    """See :class:`potr_cl.raster.launcher.RasterLauncher`."""

    whole_sets = True
    lanes = 1
    key_bytes = 8  # the bitonic network sorts in place
    counter_bytes = 4 * _COUNTER_STRIDE
    subtile_bytes = 2

    def __init__(self, device: Device, rules: RasterRules) -> None:
        make = device.shared_kernel
        counters = {"COUNTER_STRIDE": _COUNTER_STRIDE}
        self._count = make("raster/tile_lists_gpu.cl", "count_tiles", **counters)
        self._scan = make("raster/tile_lists_gpu.cl", "scan_tiles", **counters)
        self._fill = make("raster/tile_lists_gpu.cl", "fill_tiles", **counters)
        self._sort = make("raster/sort_gpu.cl", "sort_tiles", SORT_CAPACITY=_SORT_CAPACITY, **counters)
        self._subtiles = make("raster/subtile_masks_gpu.cl", "subtile_masks")
        pixels = {
            "ALPHA_CAP": float(rules.alpha_cap),
            "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold,
            "NATIVE_EXP2": int(device.native_exp2),
        }
        self._composite = make("raster/composite_gpu.cl", "composite", **pixels)
        self._frame = make("raster/composite_frame_gpu.cl", "composite_frame", **pixels)

    def enqueue_offsets(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer) -> None:
        self._count.bind(views=views.table, stride=views.stride, bounds=bounds, shapes=views.shapes, counts=counts)
        _over_splats(self._count, views)
        self._scan.bind(views=views.table, counts=counts, offsets=views.offsets)
        self._scan.launch((_SCAN, len(views.views)), (_SCAN, 1))

    def enqueue_lists(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        counts: cl.Buffer,
        keys: cl.Buffer,
        for_frame: bool,
        long_lists: LongLists | None = None,
    ) -> None:
        self._fill.bind(
            views=views.table,
            stride=views.stride,
            bounds=bounds,
            shapes=views.shapes,
            counts=counts,
            keys=keys,
            capacity=views.capacity,
        )
        _over_splats(self._fill, views)
        self._sort.bind(
            views=views.table,
            keys=keys,
            offsets=views.offsets,
            intersections=views.intersections,
            counts=counts,
            capacity=views.capacity,
            longest=0xFFFFFFFF if long_lists is None else LONGEST,
        )
        _over_tiles(self._sort, views, _SORT)
        if long_lists is not None:
            long_lists.enqueue(keys, views.intersections)
        if for_frame:
            return
        self._subtiles.bind(
            views=views.table,
            stride=views.stride,
            shapes=views.shapes,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            capacity=views.capacity,
        )
        _over_tiles(self._subtiles, views, _SUBTILES)

    def enqueue_composite(
        self, views: ViewSet, background: tuple[float, float, float], image: cl.Buffer, transmittance: cl.Buffer
    ) -> None:
        red, green, blue = background
        arguments = {
            "views": views.table,
            "shapes": views.shapes,
            "colours": views.colours,
            "offsets": views.offsets,
            "intersections": views.intersections,
            "capacity": views.capacity,
            "red": red,
            "green": green,
            "blue": blue,
            "image": image,
            "transmittance": transmittance,
        }
        if len(views.views) == 1:
            self._frame.bind(**arguments)
            _over_tiles(self._frame, views, _FRAME)
        else:
            self._composite.bind(stride=views.stride, subtiles=views.subtiles, **arguments)
            _over_tiles(self._composite, views, _COMPOSITE)


def _over_splats(kernel: Kernel, views: ViewSet) -> None:
    kernel.launch((views.stride, len(views.views)), (SPLAT_GROUP, 1))


def _over_tiles(kernel: Kernel, views: ViewSet, group: int) -> None:
    """A work-group for each tile of the largest view, in every view: those beyond a view's tiles do nothing."""
    most = max(view.tiles for view in views.views)
    kernel.launch((most * group, len(views.views)), (group, 1))
