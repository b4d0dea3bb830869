"""How the removal kernels are launched: one interface for both kernel families, chosen once.

CPUs (cl/prune/removal_cpu.cl) do one view a launch, one tile a work-item; GPUs (cl/prune/removal_gpu.cl) a set of views
a launch, a tile a work-group.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.macros import gpu_limits, totals_limits
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import camera_struct
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.prepared_set import PreparedSet
from potr_cl.stages.pruning.staleness import SweepOptions

_CPU_SOURCE, _GPU_SOURCE = "prune/removal_cpu.cl", "prune/removal_gpu.cl"
#: Work-items of a work-group: PoCL would keep the private memory of more of them on its stack; and of a GPU's.
_CPU_GROUP, _GPU_GROUP = (1,), 128


@dataclass(frozen=True)
class SweepBuffers:
    """What the kernels of a set work on besides the set's own buffers.

    Attributes:
        alive: (N,) uint8, :class:`~potr_cl.stages.pruning.survivors.SplatState`.
        tiles: uint32, the list of tiles to sweep, numbered within their set.
        stale: float32, staleness of the tiles, each set's from its first tile on.
        listed: uint32, how many tiles of each set the device has listed itself.
        totals: (N, 2) int64, ΔMSE and I of each splat in the units of
            :class:`~potr_cl.stages.pruning.fixed_point.FixedPoint`.
        numbers: for GPU kernels, (n,) uint32, the numbers among those N splats of the n that the set's views were
            prepared with; None: they were prepared with all.
    """

    alive: cl.Buffer
    tiles: cl.Buffer
    stale: cl.Buffer
    listed: cl.Buffer
    totals: cl.Buffer
    numbers: cl.Buffer | None = None


class CpuSweepLauncher:
    """See :class:`SweepLauncher`.

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
        """A view's kernels, see :class:`SweepLauncher`."""
        views, fixed_point = prepared.views, self._fixed_point
        (view,) = views.views
        shapes, colours = geometry
        red, green, blue = self._background
        weight = fixed_point.weight(view.pixels)
        removal = self._device.kernel(_CPU_SOURCE, "removal", **self._macros).bind(
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
        staleness = self._device.kernel(_CPU_SOURCE, "staleness", **self._macros).bind(
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
    """See :class:`SetKernels`."""

    def __init__(self, removal: Kernel, staleness: Kernel, tiles: int) -> None:
        self._removal, self._staleness = removal, staleness
        self._tiles = tiles

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        self._removal.set(start=start)
        self._removal.launch((count,), _CPU_GROUP, queue)

    def take_out(self) -> None:
        """The sweep itself does that."""

    def target_is_known(self) -> None:
        self._removal.set(first_time=0)

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = math.inf) -> None:
        assert list_above == math.inf, "a CPU's kernels list no tiles"
        self._staleness.launch((self._tiles,), _CPU_GROUP, queue)


class GpuSweepLauncher:
    """See :class:`SweepLauncher`.

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
        """A set's kernels, see :class:`SweepLauncher`."""
        views, fixed_point = prepared.views, self._fixed_point
        shapes, colours = geometry
        red, green, blue = self._background
        picked = buffers.numbers is not None
        numbers = buffers.numbers if picked else views.table  # which is not looked at
        macros = self._macros | {"PICKED": int(picked)}
        removal = self._device.kernel(_GPU_SOURCE, "removal", **macros).bind(
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
        staleness = self._device.kernel(_GPU_SOURCE, "staleness", **macros).bind(
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
    """See :class:`SetKernels`."""

    def __init__(self, removal: Kernel, staleness: Kernel, tiles: int) -> None:
        self._removal, self._staleness = removal, staleness
        self._tiles = tiles
        self._lists_above = math.inf
        self._start = 0

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        if start != self._start:
            self._start = start
            self._removal.set(start=start)
        self._removal.launch((count * _GPU_GROUP,), (_GPU_GROUP,), queue)

    def take_out(self) -> None:
        self._staleness.launch((self._tiles * _GPU_GROUP,), (_GPU_GROUP,))

    def target_is_known(self) -> None:
        self._removal.set(first_time=0)

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = math.inf) -> None:
        if list_above != self._lists_above:
            self._lists_above = list_above
            self._staleness.set(tolerance=list_above)
        self._staleness.launch((self._tiles * _GPU_GROUP,), (_GPU_GROUP,), queue)


class SetKernels(Protocol):
    """The kernels of one set of views, with all their arguments bound."""

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        """Enqueue the sweep of so many of the set's tiles, those in the list of tiles from ``start`` on.

        Args:
            queue: another than the device's own.
        """

    def take_out(self) -> None:
        """Enqueue that the next sweep finds nothing of removed splats in the lists of views that are prepared anew."""

    def target_is_known(self) -> None:
        """From now on, sweeps compare with the target picture instead of storing it."""

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = float("inf")) -> None:
        """Enqueue what follows a removal: each tile's staleness grows by what it lost.

        Args:
            queue: another than the device's own.
            list_above: where the launcher :attr:`SweepLauncher.lists_tiles`: tiles that are staler than this are put
                into the list of tiles, from the set's first tile on, and are fresh then.
        """


class SweepLauncher(Protocol):
    """The removal kernels of one family, built for one rasterizer.

    Attributes:
        most_views: how many views one launch can do.
        most_queues: on how many queues independent launches may run at the same time.
        lists_tiles: whether the device itself can list the tiles that are stale.
    """

    most_views: int
    most_queues: int
    lists_tiles: bool

    def bind(
        self,
        prepared: PreparedSet,
        geometry: tuple[cl.Buffer, cl.Buffer],
        buffers: SweepBuffers,
        *,
        first_time: bool,
        place: int = 0,
    ) -> SetKernels:
        """Make the kernels of one set. Each set has its own, because binding arguments takes longer than a launch.

        Args:
            prepared: the set.
            geometry: its shapes and colours.
            buffers: what it shares with other sets.
            first_time: whether a sweep stores the target instead of comparing with it.
            place: of the set's counter in the buffer of listed tiles' numbers.
        """


def launcher_for(rasterizer: Rasterizer, options: SweepOptions, fixed_point: FixedPoint) -> SweepLauncher:
    """The launcher of the device's kernel family.

    Raises:
        DeviceError: the kernels cannot be built.
    """
    device, rules = rasterizer.device, rasterizer.rules
    threshold = options.transmittance_threshold
    macros: dict[str, float | int] = {
        "ALPHA_CAP": float(rules.alpha_cap),
        "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold if threshold is None else threshold,
    } | totals_limits(device)
    return launchers(device)(rasterizer, fixed_point, macros)


def launchers(device: Device) -> type[CpuSweepLauncher | GpuSweepLauncher]:
    """The kind of a device's launchers."""
    return GpuSweepLauncher if device.family == "gpu" else CpuSweepLauncher
