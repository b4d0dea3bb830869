"""Sweeps of the views that do not fit the memory budget: prepared, swept and forgotten, in every measurement."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.memory import Memory
from potr_cl.stages.pruning.fixed_point import zero_totals
from potr_cl.stages.pruning.launcher import SweepLauncher
from potr_cl.stages.pruning.prepared_views import PreparedSet, PreparedViews
from potr_cl.stages.pruning.survivors import Survivors
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers


class UncachedSweep:
    """Measures the views of which nothing is kept.

    Args:
        prepared: the views.
        launcher: of their kernels.
        survivors: the splats that are left.
        tiles: the list of tiles to sweep, room for (prepared.tiles,) uint32.

    Attributes:
        tiles_swept: so far.
    """

    def __init__(
        self, prepared: PreparedViews, launcher: SweepLauncher, survivors: Survivors, tiles: cl.Buffer
    ) -> None:
        self._prepared, self._launcher, self._survivors, self._tiles = prepared, launcher, survivors, tiles
        self._rasterizer = prepared.rasterizer
        self._device = prepared.rasterizer.device
        self.tiles_swept = 0

    def measure(self, splats: int, first_time: bool, original_sh: cl.Buffer | None) -> NDArray[np.int64]:
        """The views' part of all totals.

        Args:
            splats: N.
            first_time: whether no splat has been removed and no colour replaced yet.
            original_sh: the coefficients that the target shows; None: those that the rasterizer has.

        Returns:
            (N, 2) int64.
        """
        with Memory(self._device) as memory:
            buffers = self._buffers(memory)
            scratch = replace(buffers, totals=self._zero_totals(memory))
            for numbers in self._prepared.uncached:
                with self._prepared.prepare(numbers) as views:
                    if not first_time:
                        self._store_target(views, original_sh, scratch)
                    self._sweep_all(views, buffers, first_time=first_time)
                    self._device.queue.finish()
            totals: NDArray[np.int64] = self._device.download(buffers.totals, (splats, 2), np.int64)
            return totals

    @contextmanager
    def swept_once(self, numbers: range) -> Iterator[PreparedSet]:
        """Views prepared and swept for the sake of their sums, closed at the end of the block."""
        with self._prepared.prepare(numbers) as views:
            with Memory(self._device) as memory:
                self._sweep_all(views, self._buffers(memory), first_time=True)
                self._device.queue.finish()
            yield views

    def _store_target(self, views: PreparedSet, original_sh: cl.Buffer | None, scratch: SweepBuffers) -> None:
        """Sweep with all splats and the original colours; only the target is of interest."""
        with self._survivors.none_removed():
            self._rasterizer.project(views.views, original_sh)
            self._sweep_all(views, scratch, first_time=True)
            if original_sh is not None:
                self._rasterizer.project(views.views)
        views.zero_sums()

    def _sweep_all(self, views: PreparedSet, buffers: SweepBuffers, *, first_time: bool) -> None:
        count = views.views.tiles
        kernels = self._launcher.bind(views, self._prepared.geometry(views), buffers, first_time=first_time)
        cl.enqueue_copy(self._device.queue, self._tiles, np.arange(count, dtype=np.uint32), is_blocking=True)
        kernels.sweep_all()
        self.tiles_swept += count

    def _buffers(self, memory: Memory) -> SweepBuffers:
        """Buffers with new totals. The kernels write the staleness too, but nobody reads it here."""
        return SweepBuffers(
            alive=self._survivors.buffer,
            tiles=self._tiles,
            stale=memory.allocate(4 * self._prepared.tiles, "the tiles' staleness"),
            listed=memory.allocate(4, "the numbers of tiles to sweep"),
            totals=self._zero_totals(memory),
        )

    def _zero_totals(self, memory: Memory) -> cl.Buffer:
        return memory.upload(zero_totals(self._rasterizer.stride), "the removal effects")
