"""Removal effects of large scenes on a CPU, each view with the splats that it draws: :class:`DrawnRemoval`.

Of a large scene no view sees much. Which splats have an intersection with any tile of a view is found once, by
projecting what the view may draw a piece at a time; geometry never changes while splats are removed. A view that stays
prepared has a scene, projection, lists and totals of these splats and no others, and the scene itself is needed no more
once it is projected. Views that the memory has no room for are made again whenever they are measured
(:mod:`potr_cl.stages.pruning.passing_parts`).

What views measure is added up by the splats' numbers. All totals are integers in units that follow from all views, so
they are the same bits as of all views with all splats.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.macros import totals_limits
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.kept_views import target_bytes
from potr_cl.stages.pruning.passing_parts import PassingParts
from potr_cl.stages.pruning.removal import F64, Indices, RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.pruning.visible_parts import first_totals
from potr_cl.views.budget import default_memory
from potr_cl.views.visibility import ViewGroup

#: Splats that are projected at a time to find which of them views draw.
_PIECE = 1 << 20
#: Bytes of a view that stays prepared: of each splat (shape, colour, totals, states, two numbers) and of each
#: intersection (splat, sub-tiles, sums).
_SPLAT, _INTERSECTION = 84, 16
#: Bytes of each splat of views that pass, and of each intersection, while they are measured. What they are allowed is
#: this part of the memory; a view that takes more is measured alone.
_PASSING_SPLAT, _PASSING = 460, 1 / 4
#: Work-items of a work-group that adds totals up.
_GROUP = 64
#: Bytes of each splat beside these while a view is made that stays prepared: of its scene, and of lists to be sorted.
_MAKING = 320
#: More than any view takes.
_PLENTY = 1 << 60


@dataclass(frozen=True)
class _Drawn:
    """What a view draws.

    Attributes:
        number: of the view.
        part: that it belongs to.
        bits: a bit for each of the part's splats, packed: those that it draws.
        count: how many these are. intersections: with tiles.
        camera: of the view.
    """

    number: int
    part: ViewGroup
    bits: NDArray[np.uint8]
    count: int
    intersections: int
    camera: Camera

    @property
    def drawn(self) -> NDArray[np.bool_]:
        """(n,) which of the part's splats it draws."""
        return np.unpackbits(self.bits, count=len(self.part.splats)).view(bool)

    @property
    def nbytes(self) -> int:
        """What it takes while it stays prepared."""
        return _SPLAT * self.count + _INTERSECTION * self.intersections + target_bytes(self.camera)


@dataclass(frozen=True)
class _View:
    """A view that stays prepared.

    Attributes:
        splats: (n,) uint32, the numbers of those that it draws, ascending.
        numbers: the same in the device's memory.
        scene: these on the device, while they are projected.
        rasterizer: of that scene.
        sweep: measures the view.
    """

    splats: NDArray[np.uint32]
    numbers: cl.Buffer
    scene: SceneBuffers
    rasterizer: Rasterizer
    sweep: RemovalSweep


class DrawnRemoval(Owner):
    """What :class:`potr_cl.stages.pruning.removal.RemovalSweep` does, view by view.

    Args:
        device: that computes.
        scene: the uncompressed scene.
        whole: the same to be drawn, perhaps on the device already.
        cameras: all views.
        parts: of the views that are measured here, which see much of the same.
        options: speed/accuracy trade-offs; the memory is that of all views together.
        background: R, G, B behind the scene.
        progress: called with the views prepared and their number.
        spared: (N,) splats whose effects are to be beyond
            :data:`potr_cl.stages.pruning.visible_parts.LARGEST_LIMIT`, so that they are never removed.

    Attributes:
        splats: N.
        steering: None: the host decides.
        kept_views: views that stay prepared, or draw nothing.

    Raises:
        DeviceError: a view does not fit the device.
    """

    steering = None

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
        self._spared = spared
        self._device, self._scene, self._whole = device, scene, whole
        self._cameras, self._background = cameras, background
        self._options = replace(options, memory=_PLENTY)
        self._fixed_point = FixedPoint.of_views(cameras)
        self._alive = np.ones(self.splats, bool)
        self._views: list[_View] = []
        self._idle: list[int] = []  # views that draw nothing: nothing is ever measured there
        memory = default_memory(device) if options.memory is None else options.memory
        passing = int(_PASSING * memory)
        left, done = memory - passing, 0
        with ExitStack() as owned:
            self._owned = owned
            self._memory = owned.enter_context(Memory(device))
            self._passing = PassingParts(device, scene, self._fill, cameras, options, self._fixed_point, background)
            owned.enter_context(self._passing)
            found: list[_Drawn] = []
            for part in parts:
                found += self._find_drawn(part)
                done += len(part.numbers)
                if progress is not None:
                    progress(done, len(cameras))
            others: list[_Drawn] = []
            # The widest first: they take most while they are made, and most again each time if they are not kept.
            for view in sorted(found, key=lambda each: (-each.nbytes, each.number)):
                if not view.count:
                    self._idle.append(view.number)
                elif view.nbytes <= left and _MAKING * view.count <= left - view.nbytes + passing:
                    self._keep(view.number, view.part.splats[view.drawn])
                    left -= view.nbytes
                else:
                    others.append(view)
            for part in parts:
                self._pass([view for view in others if view.part is part], passing)
            self._owned = owned.pop_all()
        self.kept_views = len(self._views) + len(self._idle)

    def _find_drawn(self, part: ViewGroup) -> list[_Drawn]:
        """What the views of a part draw, each by itself."""
        drawn = [np.zeros(len(part.splats), bool) for _ in part.numbers]
        counts = [0] * len(drawn)
        device, scene = self._device, self._scene
        with PreparingMemory(device) as preparing:
            for first in range(0, len(part.splats), _PIECE):
                some = part.splats[first : first + _PIECE]
                with (
                    SceneBuffers(device, len(some), scene.sh.shape[1], scene.antialiased, scene.low_pass) as piece,
                    Rasterizer(device, piece, background=self._background, preparing=preparing) as rasterizer,
                ):
                    self._fill(piece, some)
                    for place, number in enumerate(part.numbers):
                        with rasterizer.prepare_set([self._cameras[number]]) as views:
                            count = views.views[0].intersection_count
                            found = device.download(views.intersections, (count,), np.uint32)
                        drawn[place][first : first + _PIECE][found] = True
                        counts[place] += count
        return [
            _Drawn(number, part, np.packbits(own), int(np.count_nonzero(own)), count, self._cameras[number])
            for number, own, count in zip(part.numbers, drawn, counts, strict=True)
        ]

    def _keep(self, number: int, splats: Indices) -> None:
        """Have a view stay prepared."""
        device, scene = self._device, self._scene
        own = SceneBuffers(device, len(splats), scene.sh.shape[1], scene.antialiased, scene.low_pass)
        self._owned.enter_context(own)
        self._fill(own, splats)
        rasterizer = self._owned.enter_context(Rasterizer(device, own, background=self._background))
        sweep = RemovalSweep(rasterizer, self._cameras, self._options, numbers=[number])
        self._owned.enter_context(sweep)
        named = splats.astype(np.uint32)
        numbers = self._memory.upload(named, "the numbers of a view's splats")
        self._views.append(_View(named, numbers, own, rasterizer, sweep))
        self._lay_down(self._views[-1])

    def _lay_down(self, view: _View) -> None:
        """What only a projection needs."""
        self._device.queue.finish()
        view.rasterizer.rest()
        view.scene.rest()

    def _pass(self, others: Sequence[_Drawn], room: int) -> None:
        """Have views of one part measured in passing, as many together as see few enough splats."""
        together: list[int] = []
        seen = np.zeros(0, bool)

        def take() -> None:
            drawn = np.zeros(self.splats, bool)
            drawn[others[0].part.splats[seen]] = True
            self._passing.take(together, drawn)

        for view in sorted(others, key=lambda each: each.number):
            both = seen | view.drawn if together else view.drawn
            if together and _PASSING_SPLAT * int(np.count_nonzero(both)) > room:
                take()
                together, both = [], view.drawn
            together, seen = [*together, view.number], both
        if together:
            take()

    def _fill(self, part: SceneBuffers, splats: Indices) -> None:
        if isinstance(self._whole, SceneBuffers):
            part.gather(self._whole, splats)
        else:
            part.write_some(self._scene, splats)

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        return self._alive

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; the values of removed splats mean nothing."""
        return self._fixed_point.values(self.measure_totals())

    def measure_totals(self) -> NDArray[np.int64]:
        """The same as (N, 2) int64 in units of the fixed point: the sums over the views that are measured here."""
        totals = first_totals(self.splats, self._spared)
        self._add_kept(totals)
        self._passing.add_to(totals, self._alive)
        return totals

    def _add_kept(self, totals: NDArray[np.int64]) -> None:
        """Add what the views that stay prepared measure; the device adds it up."""
        if not self._views:
            return
        device = self._device
        add = device.shared_kernel("prune/parts.cl", "add_part", **totals_limits(device))
        with Memory(device) as memory:
            sums = memory.upload(totals, "the removal effects")
            for view in self._views:
                view.sweep.measure_on_device()
                count = len(view.splats)
                add.bind(totals=sums, part=view.sweep.totals, numbers=view.numbers, count=count)
                add.launch((-(-count // _GROUP) * _GROUP,), (_GROUP,))
            with device.errors("failed while computing"):
                cl.enqueue_copy(device.queue, totals, sums, is_blocking=True)

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        self._alive[splats] = False
        gone = np.zeros(self.splats, bool)
        gone[splats] = True
        for view in self._views:
            view.sweep.remove(np.flatnonzero(gone[view.splats]))

    def replace_sh(self, sh: FloatArray) -> None:
        """Continue with other colours, (N, M, 3) float32 of the same degree. The target pictures stay as they are."""
        for view in self._views:
            splats = view.splats.astype(np.int64)
            view.scene.wake()
            self._fill(view.scene, splats)
            view.scene.write_sh_of(sh, splats)
            view.sweep.project_again()
            self._lay_down(view)
        self._passing.replace_sh(sh)

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        for view in self._views:
            view.sweep.sweep_everything()
        self._passing.forget()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """See :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances`."""
        self.sweep_changed()
        yield from self.known_importances()

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured, in the views that are kept."""
        for view in self._views:
            view.sweep.sweep_changed()

    def known_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` right after :meth:`sweep_changed`."""
        found = [self._importances(view) for view in self._views]
        idle = ((number, np.zeros(0, np.int64), np.zeros(0)) for number in sorted(self._idle))
        yield from heapq.merge(*found, idle, self._passing.importances(self._alive), key=lambda each: each[0])

    def _importances(self, view: _View) -> Iterator[tuple[int, Indices, F64]]:
        for number, seen, importances in view.sweep.known_importances():
            yield number, view.splats[seen].astype(np.int64), importances

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
