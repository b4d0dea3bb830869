"""Who enqueues the rasterizer's stages after the projection: one interface, with a launcher for each kernel family.

:func:`launcher_for` chooses once; nothing else in the rasterizer asks for the family.
"""

from __future__ import annotations

from typing import Protocol

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.launch_cpu import CpuLauncher
from potr_cl.raster.launch_gpu import GpuLauncher
from potr_cl.raster.long_lists import LongLists
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet


class RasterLauncher(Protocol):
    """Enqueues tile lists, depth order, sub-tiles and compositing of views that have been projected.

    Nothing here waits for the device or takes memory of it.

    Attributes:
        whole_sets: whether one launch does all views of a set; if not, every set has one view.
        lanes: how many splats a work-item of the projection does.
        key_bytes: bytes of sort keys for each intersection.
        counter_bytes: bytes of counters for each tile.
        subtile_bytes: bytes of the mask of sub-tiles for each intersection.
    """

    whole_sets: bool
    lanes: int
    key_bytes: int
    counter_bytes: int
    subtile_bytes: int

    def enqueue_offsets(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer) -> None:
        """Enqueue the tile offsets.

        Args:
            bounds: (views, stride, 4) uint16, the tiles around each splat, as the projection leaves them.
            counts: a counter for each tile, all zero.
        """

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
            bounds, counts: as :meth:`enqueue_offsets` took and left them. The counters are zero afterwards.
            keys: room for the sort keys.
            for_frame: whether the view will only be composited, once. Then sub-tiles are left out if
                :meth:`enqueue_composite` does not need them.
            long_lists: sorts long lists, which it has found; None: they are sorted as others are.
        """

    def enqueue_composite(
        self, views: ViewSet, background: tuple[float, float, float], image: cl.Buffer, transmittance: cl.Buffer
    ) -> None:
        """Enqueue the pictures of views that have lists.

        Args:
            background: R, G, B behind everything.
            image: (pixels, 3) float32, one picture behind the other.
            transmittance: (pixels,) float32, the share of the background that shows through.
        """


def launcher_for(device: Device, rules: RasterRules) -> RasterLauncher:
    """The launcher of the device's kernel family.

    Raises:
        DeviceError: a kernel cannot be built.
    """
    return GpuLauncher(device, rules) if device.family == "gpu" else CpuLauncher(device, rules)
