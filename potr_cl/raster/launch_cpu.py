"""The rasterizer's stages on CPUs: one view a launch, one tile a work-item, a vector of pixels at a time."""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.long_lists import LongLists
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.view_set import View, ViewSet, camera_struct

#: Fewest pixels of a sub-tile, see cl/include/subtile_vectors.clh.
_LEAST_LANES = 8


class CpuLauncher:
    """See :class:`potr_cl.raster.launcher.RasterLauncher`."""

    whole_sets = False
    key_bytes = 16  # merging needs room for as many keys again
    counter_bytes = 4
    subtile_bytes = 4

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self.lanes = device.vector_width
        lanes = max(self.lanes, _LEAST_LANES)
        make = device.shared_kernel
        self._count = make("raster/tile_lists_cpu.cl", "count_tiles")
        self._scan = make("raster/tile_lists_cpu.cl", "scan_tiles")
        self._fill = make("raster/tile_lists_cpu.cl", "fill_tiles")
        self._sort = make("raster/sort_cpu.cl", "sort_tiles")
        self._subtiles = make("raster/subtile_masks_cpu.cl", "subtile_masks", LANES=lanes)
        self._composite = make(
            "raster/composite_cpu.cl",
            "composite",
            LANES=lanes,
            ALPHA_CAP=float(rules.alpha_cap),
            TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
        )

    def enqueue_offsets(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer) -> None:
        (view,) = views.views
        self._count.bind(bounds=bounds, shapes=views.shapes, view=camera_struct(view.camera), counts=counts)
        _over_splats(self._count, views)
        self._scan.bind(counts=counts, offsets=views.offsets, tiles=view.tiles)
        self._scan.launch((1,), (1,))

    def enqueue_lists(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        counts: cl.Buffer,
        keys: cl.Buffer,
        for_frame: bool,
        long_lists: LongLists | None = None,
    ) -> None:
        (view,) = views.views
        camera, capacity = camera_struct(view.camera), views.capacity
        self._fill.bind(bounds=bounds, shapes=views.shapes, view=camera, counts=counts, keys=keys, capacity=capacity)
        _over_splats(self._fill, views)
        self._sort.bind(
            keys=keys, offsets=views.offsets, intersections=views.intersections, counts=counts, capacity=capacity
        )
        _over_tiles(self._sort, view)
        self._subtiles.bind(
            shapes=views.shapes,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            capacity=capacity,
            view=camera,
        )
        _over_tiles(self._subtiles, view)

    def enqueue_composite(
        self, views: ViewSet, background: tuple[float, float, float], image: cl.Buffer, transmittance: cl.Buffer
    ) -> None:
        (view,) = views.views
        red, green, blue = background
        self._composite.bind(
            shapes=views.shapes,
            colours=views.colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            capacity=views.capacity,
            view=camera_struct(view.camera),
            red=red,
            green=green,
            blue=blue,
            image=image,
            transmittance=transmittance,
        )
        _over_tiles(self._composite, view)


def _over_splats(kernel: Kernel, views: ViewSet) -> None:
    kernel.launch((views.stride,), (SPLAT_GROUP,))


def _over_tiles(kernel: Kernel, view: View) -> None:
    # Work-groups of one: PoCL would keep the private memory of more work-items on its stack.
    kernel.launch((view.tiles,), (1,))
