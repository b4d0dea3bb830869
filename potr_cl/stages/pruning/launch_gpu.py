"""Launching the removal kernels for GPUs (cl/prune/removal_gpu.cl): a set of views a launch, a tile a work-group."""

from __future__ import annotations

import math

import pyopencl as cl

from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.macros import gpu_limits
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.prepared_set import PreparedSet
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers

_SOURCE = "prune/removal_gpu.cl"
#: Work-items of a work-group.
_GROUP = 128


class GpuRemovalLauncher:
    """See :class:`potr_cl.stages.pruning.launcher.SweepLauncher`.

    Args:
        rasterizer: of the views.
        fixed_point: the totals' units.
        macros: that both families' kernels are built with.
    """

    most_views = 32
    #: A set's longest tile list keeps one work-group busy when all others are done: other sets fill the gap.
    most_queues = 4
    lists_tiles = True

    def __init__(self, rasterizer: Rasterizer, fixed_point: FixedPoint, macros: dict[str, float | int]) -> None:
        self._device = rasterizer.device
        self._background = rasterizer.background
        self._stride = rasterizer.stride
        self._fixed_point = fixed_point
        self._macros = macros | gpu_limits(self._device)

    def bind(
        self,
        prepared: PreparedSet,
        geometry: tuple[cl.Buffer, cl.Buffer],
        buffers: SweepBuffers,
        *,
        first_time: bool,
        place: int = 0,
    ) -> _GpuKernels:
        """A set's kernels, see :class:`~potr_cl.stages.pruning.launcher.SweepLauncher`."""
        views, fixed_point = prepared.views, self._fixed_point
        shapes, colours = geometry
        red, green, blue = self._background
        picked = buffers.numbers is not None
        numbers = buffers.numbers if picked else views.table  # which is not looked at
        macros = self._macros | {"PICKED": int(picked)}
        removal = self._device.kernel(_SOURCE, "removal", **macros).bind(
            start=0,
            tiles=buffers.tiles,
            views=views.table,
            view_count=len(views.views),
            stride=self._stride,
            shapes=shapes,
            colours=colours,
            offsets=views.offsets,
            lengths=prepared.lengths,
            intersections=views.intersections,
            subtiles=views.subtiles,
            red=red,
            green=green,
            blue=blue,
            first_time=int(first_time),
            scale=fixed_point.scale,
            most_pixels=fixed_point.pixels,
            bound=fixed_point.bound,
            target=prepared.target,
            sums=prepared.sums,
            numbers=numbers,
            totals=buffers.totals,
        )
        staleness = self._device.kernel(_SOURCE, "staleness", **macros).bind(
            alive=buffers.alive,
            numbers=numbers,
            views=views.table,
            view_count=len(views.views),
            offsets=views.offsets,
            lengths=prepared.lengths,
            intersections=views.intersections,
            subtiles=views.subtiles,
            sums=prepared.sums,
            first=prepared.first_tile,
            stale=buffers.stale,
            tolerance=math.inf,
            tiles=buffers.tiles,
            set=place,
            listed=buffers.listed,
        )
        return _GpuKernels(removal, staleness, views.tiles)


class _GpuKernels:
    """See :class:`potr_cl.stages.pruning.launcher.SetKernels`."""

    def __init__(self, removal: Kernel, staleness: Kernel, tiles: int) -> None:
        self._removal, self._staleness = removal, staleness
        self._tiles = tiles
        self._lists_above = math.inf
        self._start = 0

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        if start != self._start:
            self._start = start
            self._removal.set(start=start)
        self._removal.launch((count * _GROUP,), (_GROUP,), queue)

    def sweep_all(self) -> None:
        self.note_removal()  # the sweep itself takes nothing out of the lists
        self.sweep(0, self._tiles)

    def target_is_known(self) -> None:
        self._removal.set(first_time=0)

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = math.inf) -> None:
        if list_above != self._lists_above:
            self._lists_above = list_above
            self._staleness.set(tolerance=list_above)
        self._staleness.launch((self._tiles * _GROUP,), (_GROUP,), queue)
