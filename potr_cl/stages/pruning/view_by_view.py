"""Removal effects of large scenes on a GPU, each view with the splats that it may draw: :class:`ViewByView`.

Of a large scene no view sees much. The whole scene lies on the device once; a view has its own numbers of splats, and
its projection and lists are of these and no others. What it measures is added to the scene's totals by the splats'
numbers there. Totals are integers in units that follow from all views, so they are the same bits as of all views with
all splats.

Views that the memory has no room for are prepared again whenever they are measured, some neighbours at a time and only
with the splats that are left; their target pictures stay, if there is room for them. They are measured when on the
average they have lost half as much since the last time as a tile may lose before it is swept again: some tiles lose far
more than the average.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import TypeGuard

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.picked_splats import Picker, Picks
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.kept_views import SPLAT, KeptViews, target_bytes, tiles_of
from potr_cl.stages.pruning.passing_views import PassingViews
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.stages.pruning.queues import Queues
from potr_cl.stages.pruning.removal import F64, Indices
from potr_cl.stages.pruning.shrinking_scene import ShrinkingScene
from potr_cl.stages.pruning.survivors import Bits
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.pruning.view_batches import Batch
from potr_cl.views.budget import default_memory
from potr_cl.views.visibility import Visibility

#: Views that are swept at the same time: the longest list of one keeps a work-group busy when the others are done.
_QUEUES = 8
#: Of the memory, what views may take that are made again.
_PASSING = 1 / 5


def can_go_by_view(scene: Drawable, device: Device, options: SweepOptions) -> TypeGuard[SceneBuffers]:
    """Whether a scene can be looked at view by view: on a GPU that has it, where staleness alone chooses tiles."""
    return isinstance(scene, SceneBuffers) and device.family == "gpu" and options.only_by_tolerance


class ViewByView(Owner):
    """What :class:`potr_cl.stages.pruning.removal.RemovalSweep` does, for large scenes on a GPU.

    Args:
        device: that computes.
        whole: the uncompressed scene on it.
        cameras: all views.
        sights: what each of them may draw.
        options: speed/accuracy trade-offs; tiles are chosen by their staleness alone.
        background: R, G, B behind the scene.
        progress: called with the views prepared and their number.
        first_totals: (N, 2) int64 that the scene's totals begin with; None: zeros.
        numbers: of the views that are measured here, where others are measured elsewhere and all totals are added up;
            None: all.

    Attributes:
        splats: N.
        device, totals, marks, units: see :class:`~potr_cl.stages.pruning.steering.Steered`.
        kept_views: views that stay prepared.

    Raises:
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        whole: SceneBuffers,
        cameras: Sequence[Camera],
        sights: Visibility,
        options: SweepOptions,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        progress: Callable[[int, int], None] | None = None,
        first_totals: NDArray[np.int64] | None = None,
        numbers: Sequence[int] | None = None,
    ) -> None:
        self.device, self.splats = device, whole.splats
        self._cameras, self._options, self._seen = cameras, options, sights.seen
        self._fixed_point = FixedPoint.of_views(cameras)
        self.units = self._fixed_point.units
        queues = Queues(device, _QUEUES)
        own = np.ones(len(cameras), bool)
        if numbers is not None:
            own[:] = False
            own[list(numbers)] = True
        with ExitStack() as owned:
            memory = owned.enter_context(Memory(device))
            self.totals = memory.allocate(16 * whole.stride, "the removal effects")
            device.fill(self.totals, np.int64(0))
            if first_totals is not None:
                with device.errors("cannot hold the removal effects to begin with"):
                    cl.enqueue_copy(device.queue, self.totals, first_totals, is_blocking=True)
            self._scene = owned.enter_context(
                ShrinkingScene(device, whole, options, self._fixed_point, background, queues.wait)
            )
            self.marks: cl.Buffer = self._scene.survivors.buffer
            picker = owned.enter_context(Picker(device, sights.groups.group_of))
            with Memory(device) as picking:
                picks = Picks(picking, picker, sights.seen)
                tiles = sum(tiles_of(camera) for camera in cameras)
                self._kept = owned.enter_context(KeptViews(self._scene, tiles, len(cameras), self.totals, queues))
                self._passing = owned.enter_context(
                    PassingViews(self._scene, cameras, picker, self.totals, self._kept.listed)
                )
                self._prepare_all(sights, own, picks, progress)
            self._owned = owned.pop_all()
        self.kept_views = len(self._kept)

    @property
    def steering(self) -> ViewByView:
        """Itself: the device chooses."""
        return self

    def _prepare_all(
        self,
        sights: Visibility,
        mine: NDArray[np.bool_],
        picks: Picks,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        totals = np.where(mine, sights.totals, 0)
        targets = np.array([target_bytes(camera) for camera in self._cameras]) * mine
        left = default_memory(self.device) if self._options.memory is None else self._options.memory
        passing = int(_PASSING * left)
        # For the targets of all views that are not kept room is left, unless all will be kept.
        reserved = 0
        if SPLAT * int(totals.sum()) + int(targets.sum()) > left:
            left -= passing + 16 * self._scene.whole.stride
            reserved = int(targets.sum())
        others = []
        for done, number in enumerate(sights.order().tolist()):
            own = int(targets[number])
            reserved = max(reserved - own, 0)
            if totals[number]:
                kept = self._kept.keep(number, self._cameras[number], picks, left - reserved)
                if not kept:
                    others.append(number)
                left -= kept or own
            if progress is not None:
                progress(done + 1, len(self._cameras))
        self._kept.ready()
        self._passing.take(others, sights, targets, passing, room=left + int(targets[others].sum()))

    # ------------------------------------------------------------------------------ for a controller on the device

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._scene.survivors.alive

    def measure_on_device(self) -> None:
        """Bring the totals up to date."""
        self._kept.sweep_listed()
        self._passing.measure()

    def remove_marked(self) -> None:
        """Take the splats out that are marked JUST_REMOVED."""
        self._kept.list_stale(self._options.tolerance)
        self._scene.survivors.marked_by_device()
        self._scene.pristine = False

    def mark(self, splats: Bits) -> None:
        """See :meth:`potr_cl.stages.pruning.steering.Steering.mark`."""
        self._scene.survivors.mark(splats)

    def just_marked(self) -> Bits:
        """The splats that are marked JUST_REMOVED, see :meth:`Survivors.just_marked`."""
        return self._scene.survivors.just_marked()

    # ----------------------------------------------------------------------------------- for a controller on the host

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        return self._fixed_point.values(self.measure_totals())

    def measure_totals(self) -> NDArray[np.int64]:
        """The same as (N, 2) int64 in units of the fixed point: the sums over the views that are measured here."""
        self.measure_on_device()
        return self.device.download(self.totals, (self.splats, 2), np.int64)

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        self._scene.survivors.remove(splats)
        self._kept.list_stale(self._options.tolerance)
        self._scene.pristine = False

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        self._kept.replace_sh(sh)
        self.sweep_everything()

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self._kept.list_everything()
        self._passing.forget()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """See :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances`."""
        self.sweep_changed()
        yield from self.known_importances()

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured, in the views that are kept."""
        self._kept.list_stale(0.0)
        self._kept.sweep_listed()

    def known_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` of the views that are measured here, right after :meth:`sweep_changed`."""
        alive = self.alive
        kept = {each.view.number: each for each in self._kept}
        for number in sorted([*kept, *self._passing.numbers]):
            if number in kept:
                view = kept[number].view
                yield self._importances(number, kept[number].prepared, view.numbers, view.splats, alive)
                continue
            with self._passing.swept(Batch([number], self._seen[number]), None) as ready:
                if ready is None:
                    yield number, np.zeros(0, np.int64), np.zeros(0)
                else:
                    yield self._importances(number, ready.prepared, ready.numbers, ready.splats, alive)

    def _importances(
        self, number: int, prepared: PreparedSet, numbers: cl.Buffer, splats: int, alive: NDArray[np.bool_]
    ) -> tuple[int, Indices, F64]:
        named = self.device.download(numbers, (splats,), np.uint32).astype(np.int64)
        ((_, _, intersections, sums),) = prepared.read_sums()
        weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
        total = np.bincount(intersections, weights=weights, minlength=splats)
        seen = np.flatnonzero((total > 0) & alive[named])
        camera = self._cameras[number]
        return number, named[seen], total[seen] / (camera.width * camera.height)

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
