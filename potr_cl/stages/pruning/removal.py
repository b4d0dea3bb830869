"""Removal effects and importances of all splats over all views (paper sections "Splat importance", "Effect of a
splat's removal"). Start with :class:`RemovalSweep`.

A view's projection, tile lists and depth order are made once: pruning never changes them, it only takes intersections
out. Each measurement is one sweep over the tiles of every view (cl/prune/removal_*.cl), whose sums go to exact integer
totals a splat; a tile in which little has changed since its last sweep keeps its sums. What does not fit the memory
budget is made again when it is needed: first the projections, then whole views.

The parts: sweep_options.py (what may be traded for speed), prepared_views.py (the views, and which fit the budget),
launcher.py (the kernels of either family), cached_sweep.py and uncached_sweep.py (measuring views that fit and views
that do not), staleness.py (which tiles are swept again), survivors.py (which splats are left), fixed_point.py (the
totals' units) and steering.py (all of it for a controller on the device).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.cached_sweep import CachedSweep
from potr_cl.stages.pruning.fixed_point import FixedPoint, zero_totals
from potr_cl.stages.pruning.launcher import launcher_for
from potr_cl.stages.pruning.prepared_views import PreparedSet, PreparedViews
from potr_cl.stages.pruning.queues import Queues
from potr_cl.stages.pruning.staleness import TileSchedule
from potr_cl.stages.pruning.steering import Steering
from potr_cl.stages.pruning.survivors import Survivors
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.pruning.uncached_sweep import UncachedSweep
from potr_cl.views.budget import default_memory

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]


class RemovalSweep(Owner):
    """Measures removal effects and importances while splats are taken out.

    Args:
        rasterizer: holds the uncompressed scene, its rules and its background.
        cameras: the views that count.
        options: speed/accuracy trade-offs.
        progress: called with the views prepared and their number.
        numbers: of the views that are measured here, ascending, where others are measured elsewhere and all totals are
            added up (:mod:`potr_cl.stages.pruning.shared_removal`); None: all.

    Attributes:
        splats: N.
        fixed_point: the totals' units, those of all views.
        cached_views: views whose lists fit the memory budget; the others are made again for every measurement.
        steering: the interface for a controller that runs on the device; None if the host has to decide, because of the
            kernel family, the options, or views that do not fit the budget.

    Raises:
        UsageError: no camera.
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        options: SweepOptions | None = None,
        progress: Callable[[int, int], None] | None = None,
        numbers: Sequence[int] | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("removal effects need at least one view")
        options = options or SweepOptions()
        self._numbers = range(len(cameras)) if numbers is None else numbers
        self._rasterizer = rasterizer
        self._device = device = rasterizer.device
        self.fixed_point = FixedPoint.of_views(cameras)
        self._original_sh: cl.Buffer | None = None
        self.splats = rasterizer.splats
        with ExitStack() as owned:
            self._memory = memory = owned.enter_context(Memory(device))
            self._totals = memory.upload(zero_totals(rasterizer.stride), "the removal effects")
            launcher = launcher_for(rasterizer, options, self.fixed_point)
            budget = default_memory(device) if options.memory is None else options.memory
            self._prepared = prepared = owned.enter_context(
                PreparedViews(rasterizer, [cameras[k] for k in self._numbers], budget, launcher.most_views, progress)
            )
            # Sets that share the memory of their projections have to be swept one after the other.
            queues = Queues(device, 1 if prepared.geometry_is_shared else launcher.most_queues)
            self._survivors = owned.enter_context(Survivors(device, self.splats, rasterizer.stride, queues.wait))
            tiles = memory.allocate(4 * prepared.tiles, "the tiles to sweep")
            schedule = TileSchedule(options, [(self._numbers[k], tiles) for k, tiles in prepared.cached_view_tiles])
            self._cached = owned.enter_context(
                CachedSweep(prepared, launcher, queues, self._survivors, schedule, tiles, self._totals)
            )
            self._uncached = UncachedSweep(prepared, launcher, self._survivors, tiles)
            self._owned = owned.pop_all()
        self.cached_views = len(prepared.cached_view_tiles)
        self.steering: Steering | None = None
        if launcher.lists_tiles and options.only_by_tolerance and not prepared.uncached:
            self.steering = Steering(
                device,
                self._cached,
                self._survivors,
                options.tolerance,
                self._totals,
                self.fixed_point.units,
                self.splats,
            )

    @property
    def sweeps(self) -> float:
        """Work done so far, as a multiple of sweeping every tile of every view once."""
        return (self._cached.tiles_swept + self._uncached.tiles_swept) / self._prepared.tiles

    @property
    def projects(self) -> bool:
        """Whether measurements project splats again; if not, the scene's parameters are not looked at any more."""
        return bool(self._prepared.uncached) or self._prepared.geometry_is_shared

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._survivors.alive

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing.

        ΔMSE is the change of the mean squared error over all views, pixels and channels against the uncompressed
        scene's renders if that splat alone went; I the mean over views and pixels of T α.
        """
        return self.fixed_point.values(self.measure_totals())

    @property
    def totals(self) -> cl.Buffer:
        """The totals of the views that stay prepared, (N, 2) int64 in the device's memory."""
        return self._totals

    def measure_on_device(self) -> None:
        """Bring :attr:`totals` up to date."""
        self._cached.measure()

    def measure_totals(self) -> NDArray[np.int64]:
        """The same as (N, 2) int64 in units of the fixed point: the sums over the views that are measured here."""
        first_time = self._cached.measurements == 0
        self.measure_on_device()
        totals = self._device.download(self._totals, (self.splats, 2), np.int64)
        if self._prepared.uncached:
            totals += self._uncached.measure(self.splats, first_time, self._original_sh)
        return totals

    def remove(self, splats: Indices) -> None:
        """Take splats, (n,) by number, out of all lists; note how much each tile loses."""
        self._cached.settle()
        self._survivors.remove(splats)
        self._cached.note_removal()

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        self._cached.settle()
        before = self._rasterizer.sh
        former = self._rasterizer.replace_sh(sh)
        if self._original_sh is None:
            self._original_sh = before
            if former is not None:
                self._memory.adopt(former)
        elif former is not None:
            self._device.free(former)
        self.project_again()

    def project_again(self) -> None:
        """Continue with the colours that the rasterizer's scene has by now; so with others, if it has got others."""
        self._cached.settle()
        for views in self._prepared.cached:
            if views.views.shapes is not None:
                self._rasterizer.project(views.views)
        self.sweep_everything()

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self._cached.forget_sums()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """I_k(s) of the splats that are left, view by view.

        Yields:
            The number of the view among the cameras, the splats that it sees, ascending, and the mean of T α of each
            over the view's pixels.

        Raises:
            UsageError: nothing has been measured yet.
        """
        self.sweep_changed()
        yield from self.known_importances()

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured.

        Raises:
            UsageError: nothing has been measured yet.
        """
        if not self._cached.measurements:
            raise UsageError("importances are known after a measurement")
        self._cached.sweep_changed()

    def known_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` of the views that are measured here, right after :meth:`sweep_changed`."""
        cached = {views.numbers: views for views in self._prepared.cached}
        for numbers in sorted([*cached, *self._prepared.uncached], key=lambda numbers: numbers.start):
            if numbers in cached:
                yield from self._importances(cached[numbers])
            else:
                with self._uncached.swept_once(numbers) as views:
                    yield from self._importances(views)

    def _importances(self, prepared: PreparedSet) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` of the views of a set."""
        alive = self._survivors.alive
        for number, view, intersections, sums in prepared.read_sums():
            weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
            total = np.bincount(intersections, weights=weights, minlength=self.splats)[: self.splats]
            splats = np.flatnonzero((total > 0) & alive)
            yield self._numbers[number], splats, total[splats] / view.pixels

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
