"""Removal effects of scenes of which no view sees much, on GPUs that have no room for them: :class:`PartedRemoval`.

Views are dealt out to parts that see much of the same (:mod:`potr_cl.views.visibility`). Each part has a scene of the
splats that its views may draw, and a :class:`~potr_cl.stages.pruning.removal.RemovalSweep` of its own, which projects
these and no others. What the parts measure is added up by the splats' numbers. All totals are integers in units that
follow from all views, so they are the same bits as of all views with all splats.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP, Drawable, SceneBuffers
from potr_cl.stages.pruning.fixed_point import FixedPoint, zero_totals
from potr_cl.stages.pruning.removal import F64, Indices, RemovalSweep
from potr_cl.stages.pruning.steering import Steering
from potr_cl.stages.pruning.survivors import Bits, Survivors
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.views.budget import default_memory
from potr_cl.views.visibility import ViewGroup, work

#: The parts' scenes stay on the device if they take no more than this part of the memory.
SCENES = 1 / 2
#: Bytes that a view takes for each splat of its part while it is measured, or prepared to be kept: room for one is set
#: aside, and no more than this part of the memory.
_IN_HAND, _MOST_IN_HAND = 120, 1 / 4
#: The total that spares a splat: a ΔMSE of about 1, by the bounds of :class:`FixedPoint`; and what limits it is beyond.
_SPARED, LARGEST_LIMIT = 1 << 58, 0.1

_SOURCE = "prune/parts.cl"
_GROUP = 64


def first_totals(splats: int, spared: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    """(N, 2) totals to begin with, for which an effect beyond all limits keeps a splat.

    Args:
        splats: N.
        spared: (N,) the splats to keep; None: none.
    """
    totals = np.zeros((splats, 2), np.int64)
    if spared is not None:
        totals[spared, 0] = _SPARED
    return totals


@dataclass(frozen=True)
class _Part:
    """A part at work.

    Attributes:
        splats: their numbers in the scene, ascending.
        scene: these splats on the device; they may rest.
        rasterizer: of that scene.
        sweep: measures the part's views.
        numbers: the same as ``splats`` in the device's memory, uint32.
    """

    splats: Indices
    scene: SceneBuffers
    rasterizer: Rasterizer
    sweep: RemovalSweep
    numbers: cl.Buffer


class PartedRemoval(Owner):
    """What :class:`potr_cl.stages.pruning.removal.RemovalSweep` does, part by part.

    Args:
        device: that computes.
        scene: the uncompressed scene.
        whole: the same to be drawn, perhaps on the device already.
        cameras: all views.
        parts: of the views; together they have all.
        options: speed/accuracy trade-offs; the memory is that of all parts together, their scenes included.
        background: R, G, B behind the scene.
        progress: called with the views prepared and their number.
        spared: (N,) splats whose effects are to be beyond :data:`LARGEST_LIMIT`, so that they are never removed.

    Attributes:
        splats, steering: as of a :class:`~potr_cl.stages.pruning.removal.RemovalSweep`.
        kept_views: views that stay prepared.

    Raises:
        DeviceError: a part's scene or a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        whole: Drawable,
        cameras: Sequence[Camera],
        parts: Sequence[ViewGroup],
        options: SweepOptions,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        progress: Callable[[int, int], None] | None = None,
        spared: NDArray[np.bool_] | None = None,
    ) -> None:
        self.splats = len(scene)
        self._first_totals = first_totals(self.splats, spared)
        self._device, self._scene, self._whole = device, scene, whole
        self._fixed_point = FixedPoint.of_views(cameras)
        self._alive = np.ones(self.splats, bool)
        self._parts: list[_Part] = []
        self.steering: _PartedSteering | None = None
        left = default_memory(device) if options.memory is None else options.memory
        sizes = [len(part.splats) * scene.nbytes // max(len(scene), 1) for part in parts]
        #: Whether the parts' scenes are on the device only where they are needed.
        self._rest = sum(sizes) > SCENES * left
        left = max(left - (max(sizes) if self._rest else sum(sizes)), 0)
        left -= min(_IN_HAND * max(len(part.splats) for part in parts), int(_MOST_IN_HAND * left))
        done = 0

        def report(some: int, _: int) -> None:
            if progress is not None:
                progress(done + some, len(cameras))

        with ExitStack() as owned:
            self._memory = owned.enter_context(Memory(device))
            for place, part in enumerate(parts):
                before = device.allocated
                room = int(left * work([part]) / max(work(parts[place:]), 1))
                own = SceneBuffers(device, len(part.splats), scene.sh.shape[1], scene.antialiased, scene.low_pass)
                owned.enter_context(own)
                nbytes = own.nbytes
                self._fill(own, part.splats)
                rasterizer = owned.enter_context(Rasterizer(device, own, background=background))
                sweep = RemovalSweep(rasterizer, cameras, replace(options, memory=room), report, part.numbers)
                owned.enter_context(sweep)
                numbers = self._memory.upload(part.splats.astype(np.uint32), "the numbers of a part's splats")
                self._parts.append(_Part(part.splats, own, rasterizer, sweep, numbers))
                self._lay_down(self._parts[-1])
                left = max(left - (device.allocated - before - (0 if own.rests else nbytes)), 0)
                done += len(part.numbers)
            if all(part.sweep.steering is not None for part in self._parts):
                self.steering = owned.enter_context(_PartedSteering(self, device))
            self._owned = owned.pop_all()
        self.kept_views = sum(part.sweep.cached_views for part in self._parts)

    @contextmanager
    def awake(self, part: _Part) -> Iterator[None]:
        """Make sure that a part's scene is on the device inside the block, if its measurement looks at it."""
        if part.sweep.projects and part.scene.rests:
            part.scene.wake()
            self._fill(part.scene, part.splats)
        yield
        self._lay_down(part)

    def _fill(self, part: SceneBuffers, splats: Indices) -> None:
        if isinstance(self._whole, SceneBuffers):
            part.gather(self._whole, splats)
        else:
            part.write_some(self._scene, splats)

    def _lay_down(self, part: _Part) -> None:
        if self._rest:
            part.rasterizer.rest()
            part.scene.rest()

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._alive if self.steering is None else self._alive & self.steering.alive

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        return self._fixed_point.values(self.measure_totals())

    def measure_totals(self) -> NDArray[np.int64]:
        """The same as (N, 2) int64 in units of the fixed point: the sums over all parts."""
        totals = self._first_totals.copy()
        for part in self._parts:
            with self.awake(part):
                totals[part.splats] += part.sweep.measure_totals()
        return totals

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        self._alive[splats] = False
        gone = np.zeros(self.splats, bool)
        gone[splats] = True
        for part in self._parts:
            part.sweep.remove(np.flatnonzero(gone[part.splats]))

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        # The scenes' own colours are those of the targets: from now on both are needed.
        self._rest = False
        for part in self._parts:
            if part.scene.rests:
                part.scene.wake()
                self._fill(part.scene, part.splats)
            part.sweep.replace_sh(sh[part.splats])

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """See :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances`."""
        self.sweep_changed()
        yield from self.known_importances()

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        for part in self._parts:
            part.sweep.sweep_everything()

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured."""
        for part in self._parts:
            with self.awake(part):
                part.sweep.sweep_changed()

    def known_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` right after :meth:`sweep_changed`."""
        yield from heapq.merge(*map(self._importances, self._parts), key=lambda found: found[0])

    def _importances(self, part: _Part) -> Iterator[tuple[int, Indices, F64]]:
        known = part.sweep.known_importances()
        while True:
            with self.awake(part):
                found = next(known, None)
            if found is None:
                return
            number, seen, importances = found
            yield number, part.splats[seen], importances

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()


class _PartedSteering(Owner):
    """A :class:`potr_cl.stages.pruning.steering.Steered` whose totals are the sums over all parts."""

    def __init__(self, removal: PartedRemoval, device: Device) -> None:
        self.device, self.splats, self.units = device, removal.splats, removal._fixed_point.units
        self._removal, self._parts = removal, removal._parts
        stride = -(-self.splats // SPLAT_GROUP) * SPLAT_GROUP
        self._memory = Memory(device)
        with device.all_or_nothing():
            first = zero_totals(stride)
            first[: self.splats] = removal._first_totals.view(np.uint32)
            self.totals: cl.Buffer = self._memory.upload(first, "the removal effects")
            self._first = self._memory.upload(first, "the removal effects to begin with")
            self._survivors = Survivors(device, self.splats, stride, device.queue.finish)
            self._add, self._mark = (device.kernel(_SOURCE, name) for name in ("add_part", "mark_part"))
        self.marks: cl.Buffer = self._survivors.buffer

    @property
    def alive(self) -> NDArray[np.bool_]:
        return self._survivors.alive

    def measure_on_device(self) -> None:
        cl.enqueue_copy(self.device.queue, self.totals, self._first)
        for part in self._parts:
            steering = _steering(part)
            with self._removal.awake(part):
                steering.measure_on_device()
            count = len(part.splats)
            self._add.bind(totals=self.totals, part=steering.totals, numbers=part.numbers, count=count)
            self._add.launch((-(-count // _GROUP) * _GROUP,), (_GROUP,))

    def remove_marked(self) -> None:
        for part in self._parts:
            steering, count = _steering(part), len(part.splats)
            self._mark.bind(states=self.marks, part=steering.marks, numbers=part.numbers, count=count)
            self._mark.launch((-(-count // _GROUP) * _GROUP,), (_GROUP,))
            steering.remove_marked()
        self._survivors.marked_by_device()

    def mark(self, splats: Bits) -> None:
        """See :meth:`potr_cl.stages.pruning.steering.Steering.mark`."""
        self._survivors.mark(splats)

    def close(self) -> None:
        self._survivors.close()
        self._memory.close()


def _steering(part: _Part) -> Steering:
    steering = part.sweep.steering
    assert isinstance(steering, Steering)
    return steering
