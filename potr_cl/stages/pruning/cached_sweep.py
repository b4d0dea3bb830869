"""Sweeps of the cached views: a tile in which little has changed since its last sweep keeps its sums.

The totals hold what each tile added at its last sweep; sweeping a tile again replaces its part exactly, because all
sums are integers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.memory import Memory, Owner
from potr_cl.stages.pruning.launcher import SetKernels, SweepLauncher
from potr_cl.stages.pruning.prepared_views import PreparedSet, PreparedViews
from potr_cl.stages.pruning.queues import Queues
from potr_cl.stages.pruning.staleness import Indices, TileSchedule, by_set
from potr_cl.stages.pruning.survivors import Survivors
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers


class CachedSweep(Owner):
    """Keeps the cached views' part of all totals up to date.

    Args:
        prepared: the views.
        launcher: of their kernels.
        queues: on which sets are swept beside each other.
        survivors: the splats that are left.
        schedule: says which of the cached views' tiles a measurement sweeps.
        tiles: the list of tiles to sweep, (prepared.tiles,) uint32.
        totals: (stride, 2) int64, zero.

    Attributes:
        measurements: done so far.
        tiles_swept: in all of them.
    """

    def __init__(
        self,
        prepared: PreparedViews,
        launcher: SweepLauncher,
        queues: Queues,
        survivors: Survivors,
        schedule: TileSchedule,
        tiles: cl.Buffer,
        totals: cl.Buffer,
    ) -> None:
        self._prepared, self._queues, self._survivors, self._schedule = prepared, queues, survivors, schedule
        self._device = device = prepared.rasterizer.device
        self.measurements = self.tiles_swept = 0
        self._listed: list[int] | None = None  # tiles of each set that the device has listed to be swept
        self._memory = Memory(device)
        try:
            stale = np.full(prepared.cached_tiles, np.inf, np.float32)
            self._buffers = SweepBuffers(
                alive=survivors.buffer,
                tiles=tiles,
                stale=self._memory.upload(stale, "the tiles' staleness"),
                listed=self._memory.allocate(4 * len(prepared.cached), "the numbers of tiles to sweep"),
                totals=totals,
            )
            self._kernels = [
                launcher.bind(part, prepared.geometry(part), self._buffers, first_time=True, place=place)
                for place, part in enumerate(prepared.cached)
            ]
        except BaseException:
            self.close()
            raise

    def measure(self) -> None:
        """Sweep the tiles that the device has listed, or, if it has not listed any, those that the schedule names."""
        if self._listed is not None:
            self._sweep_what_is_listed()
        else:
            self._survivors.settle()
            stale = self._read_staleness()
            self._sweep_tiles(self._schedule.choose(self.measurements, stale), stale)
        if self.measurements == 0:
            for kernels in self._kernels:
                kernels.target_is_known()
        self.measurements += 1

    def sweep_changed(self) -> None:
        """Sweep every tile that has lost anything since its last sweep."""
        self.settle()
        stale = self._read_staleness()
        self._sweep_tiles(self._schedule.changed(stale), stale)

    def note_removal(self) -> None:
        """Enqueue the kernels that find how much each tile has lost; to be called after :meth:`Survivors.remove`."""
        self._queues.enqueue([kernels.note_removal for kernels in self._kernels])

    def forget_sums(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self.settle()
        count = self._prepared.cached_tiles
        if count:
            self._device.fill(self._buffers.stale, np.float32(np.inf), 4 * count)

    def settle(self) -> None:
        """Wait until the last removal is noted, and sweep the tiles that the device has listed on its own."""
        if self._listed is not None:
            self._sweep_what_is_listed()
        self._survivors.settle()

    # Where a controller on the device decides (steering.py):

    @property
    def device_has_listed(self) -> bool:
        """Whether :meth:`have_listed` was called since the last sweep."""
        return self._listed is not None

    def have_listed(self, tolerance: float) -> None:
        """Have the device note what has been removed, and list the tiles that are staler than ``tolerance``."""
        counts, listed = len(self._kernels), self._buffers.listed
        self._device.fill(listed, np.uint32(0), 4 * counts)
        for kernels in self._kernels:
            kernels.note_removal(list_above=tolerance)
        self._listed = self._device.download(listed, (counts,), np.uint32).tolist()

    def _sweep_what_is_listed(self) -> None:
        assert self._listed is not None
        counts, self._listed = self._listed, None
        self._enqueue_sweeps([part.first_tile for part in self._prepared.cached], counts)
        self._queues.wait()

    # ---------------------------------------------------------------------------------------------------------------

    def _read_staleness(self) -> NDArray[np.float32]:
        return self._device.download(self._buffers.stale, (self._prepared.cached_tiles,), np.float32)

    def _sweep_tiles(self, tiles: Indices, stale: NDArray[np.float32]) -> None:
        """Sweep tiles of all cached views, numbered through, and note that in their staleness."""
        queue = self._device.queue
        lists = by_set(tiles, [part.first_tile for part in self._prepared.cached])
        if len(tiles):
            cl.enqueue_copy(queue, self._buffers.tiles, lists.tiles.astype(np.uint32), is_blocking=True)
        self._enqueue_sweeps(lists.starts, lists.counts)
        self._schedule.note_swept(stale, tiles)
        if len(tiles):
            cl.enqueue_copy(queue, self._buffers.stale, stale, is_blocking=True)
        self._queues.wait()

    def _enqueue_sweeps(self, starts: Sequence[int], counts: Sequence[int]) -> None:
        """Enqueue the sweep of so many tiles of each set, those in the list of tiles from these starts on."""
        sets = zip(self._prepared.cached, self._kernels, starts, counts, strict=True)
        self._queues.enqueue([functools.partial(self._sweep, *some) for some in sets if some[-1]])
        self.tiles_swept += sum(counts)

    def _sweep(self, part: PreparedSet, kernels: SetKernels, start: int, count: int, queue: cl.CommandQueue) -> None:
        self._prepared.project(part)
        kernels.sweep(start, count, queue)

    def close(self) -> None:
        """Give the device memory back that is this object's own."""
        self._memory.close()
