"""Launching the removal kernels for CPUs (cl/prune/removal_cpu.cl): one view a launch, one tile a work-item."""

from __future__ import annotations

import math

import pyopencl as cl

from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import camera_struct
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.prepared_set import PreparedSet
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers

_SOURCE = "prune/removal_cpu.cl"
#: Work-items of a work-group: PoCL would keep the private memory of more of them on its stack.
_GROUP = (1,)


class CpuRemovalLauncher:
    """See :class:`potr_cl.stages.pruning.launcher.SweepLauncher`.

    Args:
        rasterizer: of the views.
        fixed_point: the totals' units.
        macros: that both families' kernels are built with.
    """

    most_views = 1
    most_queues = 1
    lists_tiles = False

    def __init__(self, rasterizer: Rasterizer, fixed_point: FixedPoint, macros: dict[str, float | int]) -> None:
        self._device = rasterizer.device
        self._background = rasterizer.background
        self._fixed_point = fixed_point
        self._macros = macros | {"LANES": max(self._device.vector_width, 8)}

    def bind(
        self,
        prepared: PreparedSet,
        geometry: tuple[cl.Buffer, cl.Buffer],
        buffers: SweepBuffers,
        *,
        first_time: bool,
        place: int = 0,
    ) -> _CpuKernels:
        """A view's kernels, see :class:`~potr_cl.stages.pruning.launcher.SweepLauncher`."""
        views, fixed_point = prepared.views, self._fixed_point
        (view,) = views.views
        shapes, colours = geometry
        red, green, blue = self._background
        weight = fixed_point.weight(view.pixels)
        removal = self._device.kernel(_SOURCE, "removal", **self._macros).bind(
            start=0,
            tiles=buffers.tiles,
            shapes=shapes,
            colours=colours,
            alive=buffers.alive,
            offsets=views.offsets,
            lengths=prepared.lengths,
            intersections=views.intersections,
            subtiles=views.subtiles,
            view=camera_struct(view.camera),
            red=red,
            green=green,
            blue=blue,
            first_time=int(first_time),
            scale=fixed_point.scale * weight,
            bound=fixed_point.bound / weight,
            target=prepared.target,
            sums=prepared.sums,
            totals=buffers.totals,
        )
        staleness = self._device.kernel(_SOURCE, "staleness", **self._macros).bind(
            alive=buffers.alive,
            offsets=views.offsets,
            lengths=prepared.lengths,
            intersections=views.intersections,
            sums=prepared.sums,
            first=prepared.first_tile,
            stale=buffers.stale,
        )
        return _CpuKernels(removal, staleness, view.tiles)


class _CpuKernels:
    """See :class:`potr_cl.stages.pruning.launcher.SetKernels`."""

    def __init__(self, removal: Kernel, staleness: Kernel, tiles: int) -> None:
        self._removal, self._staleness = removal, staleness
        self._tiles = tiles

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        self._removal.set(start=start)
        self._removal.launch((count,), _GROUP, queue)

    def sweep_all(self) -> None:
        self.sweep(0, self._tiles)  # the sweep itself takes removed splats out of the lists

    def target_is_known(self) -> None:
        self._removal.set(first_time=0)

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = math.inf) -> None:
        assert list_above == math.inf, "a CPU's kernels list no tiles"
        self._staleness.launch((self._tiles,), _GROUP, queue)
