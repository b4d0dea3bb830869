"""How the removal kernels are launched: one interface for both kernel families, chosen once."""

from __future__ import annotations

from typing import Protocol

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.launch_cpu import CpuRemovalLauncher
from potr_cl.stages.pruning.launch_gpu import GpuRemovalLauncher
from potr_cl.stages.pruning.prepared_set import PreparedSet
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers
from potr_cl.stages.pruning.sweep_options import SweepOptions


class SetKernels(Protocol):
    """The kernels of one set of views, with all their arguments bound."""

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        """Enqueue the sweep of so many of the set's tiles, those in the list of tiles from ``start`` on.

        Args:
            queue: another than the device's own.
        """

    def sweep_all(self) -> None:
        """Enqueue the sweep of every tile, without what removed splats left in the lists. The list of tiles must begin
        with all numbers of the set's tiles."""

    def target_is_known(self) -> None:
        """From now on, sweeps compare with the target picture instead of storing it."""

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = float("inf")) -> None:
        """Enqueue what follows a removal: each tile's staleness grows by what it lost.

        Args:
            queue: another than the device's own.
            list_above: where the launcher :attr:`~SweepLauncher.lists_tiles`: tiles that are staler than this are put
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


def launchers(device: Device) -> type[CpuRemovalLauncher | GpuRemovalLauncher]:
    """The kind of a device's launchers."""
    return GpuRemovalLauncher if device.family == "gpu" else CpuRemovalLauncher
