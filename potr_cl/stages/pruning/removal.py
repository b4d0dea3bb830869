"""Removal effects and importances of all splats over all views (paper sections "Splat importance", "Effect of a
splat's removal"). Start with :class:`RemovalSweep`.

A view's projection, tile lists and depth order are made once: pruning never changes them, it only takes intersections
out. Each measurement is one sweep over the tiles of every view (cl/prune/removal_*.cl), whose sums go to exact integer
totals a splat, in units that follow from all views. So it makes no difference to any bit which views are looked at
together, with which splats, and which of them stay on the device: that is the plan's matter
(:mod:`potr_cl.views.plan`), and the engine's (:mod:`potr_cl.views.engine`).

The parts: sweep.py (what may be traded for speed, the totals' units, and the kernels of either family), resident.py and
streamed.py (measuring views that stay on the device and views that do not), buffers.py (which splats are left, what is
kept of views, and who numbers splats how), helpers.py (others that measure some views).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.raster.sweep import most_views
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.pruning.buffers import Bits, PreparedSet, Survivors
from potr_cl.stages.pruning.exchange import add_totals
from potr_cl.stages.pruning.resident import ResidentSweep
from potr_cl.stages.pruning.streamed import StreamedSweep
from potr_cl.stages.pruning.sweep import FixedPoint, SweepOptions
from potr_cl.views import plan as plans
from potr_cl.views.budget import default_memory, tiles_of
from potr_cl.views.engine import ViewEngine
from potr_cl.views.plan import ViewPlan
from potr_cl.views.subsets import CopiedSplats, NamedSplats, SplatSource, Subset, WholeScene
from potr_cl.views.targets import PicturesInPassing
from potr_cl.views.visibility import Visibility

if TYPE_CHECKING:
    from potr_cl.stages.pruning.helpers import RemovalHelpers

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]


class RemovalSweep(Owner):
    """Measures removal effects and importances while splats are taken out, on one device; others may help.

    Args:
        scene: the uncompressed scene, drawn by a rasterizer with its rules and its background, which stays the
            caller's; or a source of its splats, which is this object's from now on.
        cameras: all views; the totals' units follow from them.
        options: speed/accuracy trade-offs.
        progress: called with the views prepared and their number.
        numbers: of the views that are measured here, ascending, where others are measured elsewhere; None: all.
        plan: of these views; None: all of them with all splats.
        pictures: have room for those of resident views, which the first measurement leaves there.
        helpers: measure the other views. All totals are integers in units that follow from all views, so it makes no
            difference to any bit who measures which.

    Attributes:
        device: where the totals and the marks are. splats: N.
        totals: (N, 2) int64 in the device's memory.
        marks: (N,) uint8 in the device's memory, :class:`~potr_cl.stages.pruning.buffers.SplatState`. A controller on
            the device marks splats as JUST_REMOVED and calls :meth:`remove_marked`; when it marks the next ones, it
            changes the earlier marks to REMOVED.
        fixed_point: the totals' units, those of all views.
        ready_views: how many views need not be made again here: they stay, draw nothing, or others measure them.

    Raises:
        UsageError: no camera.
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        scene: Rasterizer | SplatSource,
        cameras: Sequence[Camera],
        options: SweepOptions | None = None,
        progress: Callable[[int, int], None] | None = None,
        numbers: Sequence[int] | None = None,
        plan: ViewPlan | None = None,
        helpers: RemovalHelpers | None = None,
        pictures: PicturesInPassing | None = None,
    ) -> None:
        source = scene if isinstance(scene, SplatSource) else WholeScene(scene)
        if not cameras:
            raise UsageError("removal effects need at least one view")
        options = options or SweepOptions()
        self.device, self.splats = source.device, source.splats
        self.fixed_point = FixedPoint.of_views(cameras)
        if plan is None:
            room = default_memory(self.device) if options.memory is None else options.memory
            plan = plans.whole(range(len(cameras)) if numbers is None else numbers, self.splats, room)
        self._cameras, self._pending, self._helpers = cameras, list[cl.Event](), helpers
        self._pictures, self._threshold = pictures, options.transmittance_threshold
        with ExitStack() as owned:
            owned.callback(source.close)
            self._memory = owned.enter_context(Memory(self.device))
            self.totals: cl.Buffer = self._memory.allocate(16 * source.stride, "the removal effects")
            self._own = self.totals
            if helpers is not None:
                self.device.fill(self.totals, np.int64(0))
                if plan.groups:
                    self._own = self._memory.allocate(16 * source.stride, "the removal effects")
            self.device.fill(self._own, np.int64(0))
            self._survivors = owned.enter_context(
                Survivors(self.device, self.splats, source.stride, lambda: self._resident.queues.wait())
            )
            self.marks: cl.Buffer = self._survivors.buffer
            self._engine = ViewEngine(source, cameras, plan, self._attach, most_views(self.device), progress)
            owned.enter_context(self._engine)
            self._pending.clear()
            self._resident = ResidentSweep(self._engine, self._survivors, self._own, options, self.fixed_point)
            owned.enter_context(self._resident)
            self._streamed = StreamedSweep(self._engine, self._survivors, options, self.fixed_point)
            owned.enter_context(self._streamed)
            if helpers is not None:
                helpers.are_left(self.marks, first=True)
            self._owned = owned.pop_all()
        self._measured = self._streamed_added = False
        resident = sum(len(ready.numbers) for ready in self._engine.resident)
        self.ready_views = resident + len(self._engine.idle) + (len(cameras) - len(plan.numbers) if helpers else 0)

    def _attach(
        self, numbers: Sequence[int], subset: Subset, views: ViewSet, memory: Memory | None, target: cl.Buffer | None
    ) -> PreparedSet:
        if memory is not None:
            return PreparedSet(subset.rasterizer, views, memory, target)
        picture, rules = None, subset.rasterizer.rules
        # Pictures whose pixels end later than those of pruning it cannot draw.
        if self._pictures is not None and (self._threshold or 0.0) <= rules.transmittance_threshold:
            picture = self._pictures.room_for(views)
        # The device sorts the lists while the next view is made ready.
        return PreparedSet(subset.rasterizer, views, None, target, self._pending, picture)

    @property
    def sweeps(self) -> float:
        """Work done so far, as a multiple of sweeping every tile of every view once."""
        tiles = sum(tiles_of(self._cameras[number]) for number in self._engine.plan.numbers)
        return (self._resident.tiles_swept + self._streamed.tiles_swept) / tiles

    @property
    def can_steer(self) -> bool:
        """Whether a controller on the device can decide: not where the host is asked which tiles are swept, nor where
        streamed views are measured so often that nothing is gained."""
        often = self._engine.streamed and not self._engine.plan.patience
        helpers = self._helpers is None or self._helpers.can_steer
        return self._resident.device_lists and not often and helpers

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._survivors.alive

    # ------------------------------------------------------------------------------ for a controller on the device

    def measure_on_device(self, alone: bool = False, again: bool | None = None) -> None:
        """Bring :attr:`totals` up to date.

        Args:
            alone: only what is measured here.
            again: whether streamed views are measured again; None: if they have lost enough.
        """
        streamed, resident, helpers = self._streamed, self._resident, None if alone else self._helpers
        if self._engine.streamed:
            again = streamed.are_stale() if again is None or not streamed.known else again
        # All devices measure theirs in the same iterations: they would wait for each other in each.
        pending = None if helpers is None else helpers.begin(again if self._engine.streamed else None)
        if self._engine.plan.groups:
            resident.list_stale()
            resident.sweep()
            if self._pictures is not None and not self._measured:
                self._pictures.are_drawn(view.camera for ready in self._engine.resident for view in ready.views.views)
            if resident.gather():
                self._streamed_added = False
            if self._engine.streamed and again:
                if self._streamed_added:
                    add_totals(self.device, self._own, streamed.totals, self.splats, "subtract_totals")
                self._streamed_added = False
                streamed.measure()
            if self._engine.streamed and not self._streamed_added:
                add_totals(self.device, self._own, streamed.totals, self.splats)
                self._streamed_added = True
            self._measured = True
        if helpers is not None and pending is not None:
            helpers.take(pending, self.totals)
            if self._own is not self.totals:
                add_totals(self.device, self.totals, self._own, self.splats)

    def remove_marked(self) -> None:
        """Take the splats out that are marked JUST_REMOVED; note how much each tile loses."""
        if self._helpers is not None:
            # They go on with it while this device does its own, and whoever tells them more waits for them.
            self._helpers.remove(self._survivors.just_marked())
        self._resident.note_removal()
        self._survivors.are_marked()
        if self._helpers is not None:
            self._helpers.are_left(self.marks)

    def remove_bits(self, splats: Bits) -> None:
        """Take splats out that a controller elsewhere has chosen, (N / 8, rounded up) uint8, the lowest first."""
        self._see_targets()
        self._resident.prepare_removal()
        self._survivors.mark(splats)
        self.remove_marked()

    # ----------------------------------------------------------------------------------- for a controller on the host

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing.

        ΔMSE is the change of the mean squared error over all views, pixels and channels against the uncompressed
        scene's renders if that splat alone went; I the mean over views and pixels of T α.
        """
        self.measure_on_device()
        return self.fixed_point.values(self.device.download(self.totals, (self.splats, 2), np.int64))

    def measure_totals(self) -> NDArray[np.int64]:
        """The same as (N, 2) int64 in units of the fixed point: the sums over the views that are measured here."""
        self.measure_on_device()
        return self.device.download(self.totals, (self.splats, 2), np.int64)

    def remove(self, splats: Indices) -> None:
        """Take splats, (n,) by number, out of all lists."""
        gone = np.zeros(self.splats, bool)
        gone[splats] = True
        self.remove_bits(np.packbits(gone, bitorder="little"))

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        pending = None if self._helpers is None else self._helpers.replace_sh(sh)
        self._see_targets()
        self._engine.source.replace_sh(sh)
        self._resident.project_again()
        self.sweep_everything()
        if pending is not None:
            pending.results()

    def _see_targets(self) -> None:
        """The target pictures are stored by the first measurement, before anything changes."""
        if not self._measured:
            self.measure_on_device(alone=True)

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self._resident.list_everything()
        self._streamed.forget()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """I_k(s) of the splats that are left, view by view.

        Yields:
            The number of the view among the cameras, the splats that it sees, ascending, and the mean of T α of each
            over the view's pixels.

        Raises:
            UsageError: nothing has been measured yet.
        """
        pending = None if self._helpers is None else self._helpers.sweep_changed()
        self.sweep_changed()
        others: list[Iterator[tuple[int, Indices, F64]]] = []
        if self._helpers is not None and pending is not None:
            pending.results()
            others = self._helpers.importances()
        yield from heapq.merge(self.known_importances(), *others, key=lambda found: found[0])

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured, in the resident views.

        Raises:
            UsageError: nothing has been measured yet.
        """
        if not self._measured and self._engine.plan.groups:
            raise UsageError("importances are known after a measurement")
        self._resident.sweep_changed()

    def known_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` of the views that are measured here, right after :meth:`sweep_changed`."""
        alive = self.alive
        resident = {
            number: (ready, place) for ready in self._engine.resident for place, number in enumerate(ready.numbers)
        }
        for number in self._engine.plan.numbers:
            if number in resident:
                ready, place = resident[number]
                yield number, *self._importances(ready.subset, ready.work, place, alive)
                continue
            with nullcontext() if number in self._engine.idle else self._streamed.swept(number) as found:
                if found is None:
                    yield number, np.zeros(0, np.int64), np.zeros(0)
                else:
                    yield number, *self._importances(*found, 0, alive)

    def _importances(
        self, subset: Subset, prepared: PreparedSet, place: int, alive: NDArray[np.bool_]
    ) -> tuple[Indices, F64]:
        """The splats that one view of a set sees, and their importances."""
        view, intersections, sums = prepared.read_sums(place)
        weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
        total = np.bincount(intersections, weights=weights, minlength=subset.count)[: subset.count]
        seen = np.flatnonzero(total > 0)
        splats = seen
        if subset.numbers is not None:
            named = self.device.download(subset.numbers, (subset.count,), np.uint32)
            splats = named[seen].astype(np.int64)
        left = alive[splats]
        return splats[left], total[seen[left]] / view.pixels


@dataclass(frozen=True)
class Wanted:
    """What is measured of a scene, of which views.

    Attributes:
        cameras: all views; the totals' units follow from them.
        options: speed/accuracy trade-offs.
        visibility: what the views may draw, where each had better be looked at with that; None: with all splats.
        numbers: of the views that are measured here, ascending, where others are measured elsewhere; None: all.
    """

    cameras: Sequence[Camera]
    options: SweepOptions
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    visibility: Visibility | None = None
    numbers: Sequence[int] | None = None


@contextmanager
def planned_sweep(
    device: Device,
    drawable: Drawable,
    wanted: Wanted,
    scene: Scene | None = None,
    progress: Callable[[int, int], None] | None = None,
    helpers: RemovalHelpers | None = None,
    pictures: PicturesInPassing | None = None,
) -> Iterator[RemovalSweep]:
    """A removal sweep over some views, as long as the context lasts.

    Args:
        drawable: the uncompressed scene, perhaps on the device.
        scene: the uncompressed scene on the host; None: it is there only if ``drawable`` is.
        progress, helpers, pictures: as of :class:`RemovalSweep`.
    """
    cameras, options, visibility, numbers = wanted.cameras, wanted.options, wanted.visibility, wanted.numbers
    scene = drawable if isinstance(drawable, Scene) else scene
    memory = default_memory(device) if options.memory is None else options.memory
    meant = range(len(cameras)) if numbers is None else numbers
    with ExitStack() as owned:
        source: Rasterizer | SplatSource
        plan = None
        if visibility is not None and isinstance(drawable, SceneBuffers) and _can_name(device, options):
            source = owned.enter_context(NamedSplats(drawable, visibility.groups.group_of, wanted.background))
            plan = plans.by_view(visibility, cameras, meant, memory, 16 * drawable.stride)
        elif visibility is not None and scene is not None:
            clusters = visibility.clusters(numbers)
            source = owned.enter_context(CopiedSplats(device, scene, drawable, wanted.background))
            if device.family == "cpu":
                plan = plans.as_drawn(source, cameras, clusters, memory, progress)
                progress = None  # that was most of it
            else:
                plan = plans.by_cluster(clusters, memory, scene.nbytes // max(len(scene), 1))
        else:
            source = owned.enter_context(Rasterizer(device, drawable, background=wanted.background))
        sweep = RemovalSweep(source, cameras, options, progress, numbers, plan, helpers, pictures)
        yield owned.enter_context(sweep)


def _can_name(device: Device, options: SweepOptions) -> bool:
    """Whether splats can be named by their numbers: GPU kernels can, where staleness alone chooses tiles."""
    return device.family == "gpu" and options.only_by_tolerance
