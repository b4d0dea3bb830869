"""Who enqueues the rasterizer's stages after the projection: :class:`RasterLauncher`.

CPU kernels do one view a launch, one tile a work-item, a vector of pixels at a time; GPU kernels all views of a set in
one launch, one work-group a tile. A view alone is composited by a GPU kernel of its own
(cl/raster/composite_frame_gpu.cl), which needs no sub-tiles. Nothing else in the rasterizer asks for the family.
"""

from __future__ import annotations

from typing import Any

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.preparing_memory import LONGEST, LongLists
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.view_set import ViewSet, camera_struct

#: Fewest pixels of a sub-tile on CPUs, see cl/include/subtile_vectors.clh.
_LEAST_LANES = 8
#: Words from one tile's counter to the next on GPUs: their memory does one atomic operation at a time in 32 bytes.
_COUNTER_STRIDE = 8
#: Keys that a GPU sorts in local memory: 16 KB, half of what every GPU has, so that two tiles are sorted at a time.
_SORT_CAPACITY = 2048
#: Work-items of a GPU's work-group: one view's in the scan, one tile's in the others. On CPUs one: PoCL would keep the
#: private memory of more on its stack.
_SCAN, _SORT, _SUBTILES, _COMPOSITE, _FRAME = 256, 256, 128, 128, 256


class RasterLauncher:
    """Enqueues tile lists, depth order, sub-tiles and compositing of views that have been projected.

    Nothing here waits for the device or takes memory of it.

    Args:
        device: to run on.
        rules: of the rasterizer.

    Attributes:
        whole_sets: whether one launch does all views of a set; if not, every set has one view.
        lanes: how many splats a work-item of the projection does.
        key_bytes: bytes of sort keys for each intersection.
        counter_bytes: bytes of counters for each tile.
        subtile_bytes: bytes of the mask of sub-tiles for each intersection.
    """

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self.whole_sets = gpu = device.family == "gpu"
        self.lanes = 1 if gpu else device.vector_width
        # The bitonic network of GPUs sorts in place; merging needs room for as many keys again.
        self.key_bytes, self.subtile_bytes = (8, 2) if gpu else (16, 4)
        self.counter_bytes = 4 * (_COUNTER_STRIDE if gpu else 1)
        counters = {"COUNTER_STRIDE": _COUNTER_STRIDE} if gpu else {}
        lanes = {} if gpu else {"LANES": max(self.lanes, _LEAST_LANES)}
        pixels: dict[str, Any] = {
            "ALPHA_CAP": float(rules.alpha_cap),
            "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold,
            **({"NATIVE_EXP2": int(device.native_exp2)} if gpu else {}),
        }

        def made(source: str, kernel: str, **macros: Any) -> Kernel:
            return device.shared_kernel(f"raster/{source}_{device.family}.cl", kernel, **macros)

        self._count, self._scan, self._fill = (
            made("tile_lists", f"{name}_tiles", **counters) for name in ("count", "scan", "fill")
        )
        self._sort = made("sort", "sort_tiles", **({"SORT_CAPACITY": _SORT_CAPACITY, **counters} if gpu else {}))
        self._subtiles = made("subtile_masks", "subtile_masks", **lanes)
        self._composite = made("composite", "composite", **lanes, **pixels)
        self._frame = made("composite_frame", "composite_frame", **pixels) if gpu else self._composite

    def enqueue_offsets(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer) -> None:
        """Enqueue the tile offsets.

        Args:
            views: projected.
            bounds: (views, stride, 4) uint16, the tiles around each splat, as the projection leaves them.
            counts: a counter for each tile, all zero.
        """
        of_views = self._of(views)
        self._count.bind(**of_views, **self._stride(views), bounds=bounds, shapes=views.shapes, counts=counts)
        self._over_splats(self._count, views)
        if self.whole_sets:
            self._scan.bind(**of_views, counts=counts, offsets=views.offsets)
            self._scan.launch((_SCAN, len(views.views)), (_SCAN, 1))
        else:
            self._scan.bind(counts=counts, offsets=views.offsets, tiles=views.tiles).launch((1,), (1,))

    def enqueue_lists(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        counts: cl.Buffer,
        keys: cl.Buffer,
        for_frame: bool,
        long_lists: LongLists | None = None,
    ) -> None:
        """Enqueue tile lists, depth order and sub-tiles of views that have offsets and room.

        Args:
            views, bounds, counts: as :meth:`enqueue_offsets` took and left them. The counters are zero afterwards.
            keys: room for the sort keys.
            for_frame: whether the view will only be composited, once. Then sub-tiles are left out if
                :meth:`enqueue_composite` does not need them.
            long_lists: sorts long lists on a GPU, which it has found; None: they are sorted as others are.
        """
        of_views, stride, lists = self._of(views), self._stride(views), self._lists(views)
        self._fill.bind(
            **of_views, **stride, bounds=bounds, shapes=views.shapes, counts=counts, keys=keys, capacity=views.capacity
        )
        self._over_splats(self._fill, views)
        of_sort = {}
        if self.whole_sets:
            of_sort = {**of_views, "longest": 0xFFFFFFFF if long_lists is None else LONGEST}
        self._sort.bind(**of_sort, **lists, keys=keys, counts=counts)
        self._over_tiles(self._sort, views, _SORT)
        if long_lists is not None:
            long_lists.enqueue(keys, views.intersections)
        if for_frame and self.whole_sets:
            return
        self._subtiles.bind(**of_views, **stride, **lists, shapes=views.shapes, subtiles=views.subtiles)
        self._over_tiles(self._subtiles, views, _SUBTILES)

    def enqueue_composite(
        self, views: ViewSet, background: tuple[float, float, float], image: cl.Buffer, transmittance: cl.Buffer
    ) -> None:
        """Enqueue the pictures of views that have lists.

        Args:
            views: with their lists.
            background: R, G, B behind everything.
            image: (pixels, 3) float32, one picture behind the other.
            transmittance: (pixels,) float32, the share of the background that shows through.
        """
        as_frame = self.whole_sets and len(views.views) == 1
        kernel = self._frame if as_frame else self._composite
        red, green, blue = background
        kernel.bind(
            **self._of(views),
            **({} if as_frame else {**self._stride(views), "subtiles": views.subtiles}),
            **self._lists(views),
            shapes=views.shapes,
            colours=views.colours,
            red=red,
            green=green,
            blue=blue,
            image=image,
            transmittance=transmittance,
        )
        self._over_tiles(kernel, views, _FRAME if as_frame else _COMPOSITE)

    def _of(self, views: ViewSet) -> dict[str, Any]:
        """How kernels of the family are told the views."""
        return {"views": views.table} if self.whole_sets else {"view": camera_struct(views.views[0].camera)}

    def _stride(self, views: ViewSet) -> dict[str, int]:
        return {"stride": views.stride} if self.whole_sets else {}

    def _lists(self, views: ViewSet) -> dict[str, Any]:
        return {"offsets": views.offsets, "intersections": views.intersections, "capacity": views.capacity}

    def _over_splats(self, kernel: Kernel, views: ViewSet) -> None:
        others = (len(views.views),) if self.whole_sets else ()
        kernel.launch((views.stride, *others), (SPLAT_GROUP, *(1 for _ in others)))

    def _over_tiles(self, kernel: Kernel, views: ViewSet, group: int) -> None:
        if not self.whole_sets:
            kernel.launch((views.tiles,), (1,))
            return
        # A work-group for each tile of the largest view, in every view: those beyond a view's tiles do nothing.
        most = max(view.tiles for view in views.views)
        kernel.launch((most * group, len(views.views)), (group, 1))
