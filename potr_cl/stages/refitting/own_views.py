"""The views that one worker does of a re-fit, and what they add to coefficients: :class:`OwnViews`.

One sweep over the tiles of every view (cl/refit/refit_cpu.cl, refit_gpu.cl) leads from the splats' colours
(cl/refit/view_colours.cl) to the pixels' values, and from those back to sums for each splat, which are gathered into
coefficients (cl/refit/gather.cl). W weighs pixels so that all views count the same whatever their size.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import TABLE_ENTRY, ViewSet
from potr_cl.stages.compaction.view_weights import pixel_weight
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.view_kernels import Free, RefitSweep, SweptSums, ViewKernels, gathered_scale
from potr_cl.views import plan as plans
from potr_cl.views.budget import ViewCache, free_memory, target_bytes, tiles_of
from potr_cl.views.engine import Launch, ViewEngine
from potr_cl.views.reached import Reach
from potr_cl.views.subsets import ListedSplats, Subset, WholeScene
from potr_cl.views.targets import TargetPictures, Targets


class ViewErrors(Owner):
    """Each tile's error, of all launches of a gradient.

    They are asked for once, when all is enqueued: while one thread waits for what it downloads, some drivers let no
    other one use that device, and others may want to read from it what they need to begin with their views.

    Args:
        device: that computes.
        cameras: all views. weights: what a pixel of each counts.
        launches: numbers of the views that each launch does.

    Attributes:
        latest: (tiles,) float32 on the device, where a sweep writes what it finds.
    """

    def __init__(
        self, device: Device, cameras: Sequence[Camera], weights: Sequence[float], launches: Sequence[Sequence[int]]
    ) -> None:
        self._device, self._weights = device, list(weights)
        self._numbers = [number for each in launches for number in each]
        self._ends = [0, *itertools.accumulate(tiles_of(cameras[number]) for number in self._numbers)]
        most = max((sum(tiles_of(cameras[number]) for number in each) for each in launches), default=0)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self.latest = self._memory.allocate(4 * most, "the tiles' errors")
            self._all = self._memory.allocate(4 * self._ends[-1], "the tiles' errors")

    def keep(self, views: range) -> None:
        """Enqueue that what the last sweep has found is kept until :meth:`found`; views by their place in launches."""
        first, end = self._ends[views.start], self._ends[views.stop]
        self._device.copy(self._all, self.latest, 4 * (end - first), to=4 * first)

    def found(self) -> dict[int, float]:
        """The squared error by W of each view, by its number among all; waits for the device."""
        tiles = self._device.download(self._all, (self._ends[-1],), np.float32)
        return {
            number: self._weights[number] * float(tiles[first:end].sum(dtype=np.float64))
            for number, (first, end) in zip(self._numbers, itertools.pairwise(self._ends), strict=True)
        }


#: Bytes a splat and view of a sweep's own buffers: the colours' change and the sums.
_CHANGE, _TOTALS = 16, 32
#: So much of the room for views these take at the most where several views are gathered together.
_AT_ONCE = 1 / 16
#: Vectors' bytes that are taken later, beside the sums of the splats' own blocks: the sums over views, and what the
#: solution was before it was rounded; and of packed coefficients that go to other devices and come from them.
_LATER, _EXCHANGED = 3, 3


@dataclass(frozen=True)
class Look:
    """What views are looked at with, and what is added up.

    Attributes:
        x: (3 M, stride) float32 on the device, coefficients or a direction; None: black, for blocks alone.
        targets: what pictures of coefficients should show; None: x is a direction.
        at: the coefficients that were looked at last, where x is a direction. unit: it is multiplied by this.
        constant: only constant coefficients: leave the sums of others alone; a direction's others are all 0.
        every: of so many blocks of pixels one is looked at (:meth:`RefitSweep.run`).
        back: whether sums are wanted, and not only errors.
        blocks: (M (M + 1) / 2, n) int64, to which n splats' own blocks are added. first_block: the first of these.
        drawn: (stride,) uint8, becomes 1 for each splat that any of the views draws; not where each view has splats of
            its own. None: it is not wanted.
    """

    x: cl.Buffer | None = None
    targets: Targets | None = None
    at: Vector | None = None
    unit: float | None = None
    constant: bool = False
    every: int = 1
    back: bool = True
    blocks: cl.Buffer | None = None
    first_block: int = 0
    drawn: cl.Buffer | None = None


class OwnViews(Owner):
    """Some of the views of a scene, with pixels weighed by W.

    Args:
        sweep: over views' tiles.
        rasterizer: of the scene's geometry and opacities; its colours are never looked at. It stays the caller's.
        coefficients: whose vectors are looked at.
        cameras: all views that count, all the same whatever their size.
        background: R, G, B behind the splats.
        memory: bytes of device memory that prepared views and targets may take; None: two fifths of
            what is free, or a quarter where that is the host's memory.
        numbers: of the views that are done here, ascending; None: all.
        reach: of these, where each has splats of its own; None: they share all splats.
        shared: whether other devices do other views, so that vectors and sums go from one to the other.

    Attributes:
        count: of all views.
        one: what is 1 in :attr:`sums`, and in those of the splats' own blocks.
        sums: (3 M, stride) int64 in the device's memory, what the views have added to coefficients.
    """

    def __init__(
        self,
        sweep: RefitSweep,
        rasterizer: Rasterizer,
        coefficients: Coefficients,
        cameras: Sequence[Camera],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
        numbers: Sequence[int] | None = None,
        reach: Reach | None = None,
        shared: bool = False,
    ) -> None:
        self._device = device = coefficients.device
        layout = coefficients.layout
        self._coefficients, self._background, self._sweep = coefficients, background, sweep
        weights = [pixel_weight(camera) for camera in cameras]
        self.one = gathered_scale(cameras, weights)
        self._fixed_points = sweep.fixed_point_scales(cameras)
        self.count = len(cameras)
        own_numbers = range(len(cameras)) if numbers is None else numbers
        source = WholeScene(rasterizer, reused=True) if reach is None else ListedSplats(rasterizer, reach)
        rooms = {number: source.room(number) for number in own_numbers}
        # Views of a launch have about as many splats.
        order = sorted(own_numbers, key=lambda each: (-rooms[each], each))
        # To render a picture takes many times as long as to project a view, and it takes less room.
        pictures = [target_bytes(cameras[number]) for number in own_numbers]
        later = layout.stride * (8 * layout.triangle + 4 * layout.columns * (_LATER + _EXCHANGED * shared))
        room = free_memory(device, later) if memory is None else memory
        with ExitStack() as owned:
            self._cache = owned.enter_context(ViewCache(device, room, sum(pictures)))
            self._memory = owned.enter_context(Memory(device))
            most, largest = sweep.most_views, max(pictures, default=0)
            plan = plans.in_launches(order, rooms, self._cache, most, _CHANGE + _TOTALS, largest)
            engine = ViewEngine(source, cameras, plan, _Attached, sweep.most_views)
            self._engine: ViewEngine[_Attached] = owned.enter_context(engine)
            if memory is not None:  # pictures are kept in what streamed views leave
                self._cache.room = max(self._cache.room - self._engine.passing, 0)
            rasterizer.rest()
            launches = list(self._engine.walk())
            ends = [0, *itertools.accumulate(len(each.numbers) for each in launches)]
            self._launches = [
                _Own(each, range(*views)) for each, views in zip(launches, itertools.pairwise(ends), strict=True)
            ]
            most = max((len(each.numbers) for each in launches), default=0)
            largest, together = max((each.size for each in launches), default=0), 1
            if most == 1 and reach is None:
                fitting = int(_AT_ONCE * room / ((_CHANGE + _TOTALS) * largest))
                together = max(min(sweep.gathered, len(launches), fitting), 1)
            at_once, known = together * largest, 0
            self._gathered = list[_Gathered]()
            for first in range(0, len(self._launches), together):
                own = self._launches[first : first + together]
                stays = reach is not None or all(each.launch.resident is not None for each in own)
                self._gathered.append(_Gathered(own, known if stays else None))
                known += sum(each.launch.size for each in own) * stays
            passing = any(each.free is None for each in self._gathered)
            self._passing, self._free = known, self._memory.allocate(known + passing * at_once, "what is cut")
            self._change = self._memory.allocate(_CHANGE * at_once, "the colours' change")
            self._totals = self._memory.allocate(_TOTALS * at_once, "the re-fit's sums")
            self._slots = [
                _Slot(*(_part(of, slot, together) for of in (self._change, self._totals))) for slot in range(together)
            ]
            self._tables = self._memory.allocate(TABLE_ENTRY * most * together, "the views")
            coefficients.zero(self._totals)
            self.sums = self._memory.allocate(8 * layout.columns * layout.stride, "the sums over views")
            coefficients.zero(self.sums)
            sets = [each.numbers for each in launches]
            self._errors = owned.enter_context(ViewErrors(device, cameras, weights, sets))
            numbers_of = np.array([each for some in sets for each in some], np.uint32)
            self._numbers = self._memory.upload(numbers_of, "the views' numbers")
            ratios = [self.one * weights[each] / self._fixed_points[each] for some in sets for each in some]
            scales = self._memory.upload(np.array(ratios, np.float32), "the views' scales")
            self._kernels = ViewKernels(device, layout, rasterizer.parameters.means, coefficients.active, scales)
            self._targets = owned.enter_context(TargetPictures(device, cameras, self._cache, sets=sets))
            self._owned = owned.pop_all()

    @property
    def room(self) -> float:
        """Bytes of the memory for prepared views and targets that are left."""
        return self._cache.room

    def prepare(self, targets: Targets) -> None:
        """Have the pictures of this device's views that are kept there, before the first gradient asks for them."""
        self._targets.fill([each.launch.numbers for each in self._launches], targets)

    def add_up(self, look: Look) -> None:
        """Enqueue what adds to :attr:`sums`, and to blocks, what views give."""
        kernels, targets = self._kernels, look.targets
        background = (0.0, 0.0, 0.0) if targets is None else self._background
        if look.x is None:
            self._coefficients.zero(self._change)  # black: the sums of channels are 0, whichever are free
        for gathered in self._gathered:
            every, free = gathered.views, Free(self._free, self._passing if gathered.free is None else gathered.free)
            changed, first = self._change_together(gathered, free, look), free.first
            for slot, own in zip(self._slots, gathered.launches, strict=False):
                of_own = Free(self._free, first)
                first += own.launch.size
                with self._engine.ready(own.launch) as ready:
                    views, picks, (shapes, colours) = ready.views, ready.subset.numbers, ready.geometry
                    swept, target = slot.change, None
                    if targets is not None:
                        kernels.colour(views, picks, look.x, colours, of_own)
                        swept, target = colours, self._targets.of(own.launch.numbers, targets)
                    elif look.x is not None and not changed:
                        assert look.at is not None
                        if gathered.free is None:  # which colours are cut is not known any more
                            at = self._coefficients.on_device(look.at, 1)
                            kernels.colour(views, picks, at, colours, of_own)
                        kernels.colour(views, picks, look.x, slot.change, of_own, look.unit, look.constant)
                    scale, errors = self._fixed_points[ready.numbers[0]], self._errors.latest
                    weights = look.blocks is not None
                    sampled = (self._numbers, own.views.start, look.every, look.back)
                    self._sweep.run(
                        views,
                        shapes,
                        swept,
                        background,
                        target,
                        scale,
                        *sampled,
                        errors,
                        slot.totals,
                        weights,
                        own.launch.resident is not None,
                    )
                    if targets is not None:
                        if look.drawn is not None:
                            kernels.mark_drawn(views, look.drawn)
                        self._errors.keep(own.views)
                    place = TABLE_ENTRY * (own.views.start - every.start)
                    self._device.copy(self._tables, views.table, TABLE_ENTRY * len(own.views), place)
            if not look.back:
                continue
            found = SweptSums(self._totals, free, ready.views.stride, ready.subset.numbers, self._tables, every)
            kernels.gather(found, self.sums, look.constant, look.blocks, look.first_block)

    def _change_together(self, gathered: _Gathered, free: Free, look: Look) -> bool:
        """Enqueue what a direction adds to the colours of some launches' views, if all are there with all splats."""
        there = [own.launch.resident for own in gathered.launches]
        views = [each.views for each in there if each is not None and each.subset.numbers is None]
        if look.x is None or look.targets is not None or not 1 < len(views) == len(there):
            return False
        for place, each in enumerate(views):
            self._device.copy(self._tables, each.table, TABLE_ENTRY, TABLE_ENTRY * place)
        assert look.unit is not None
        self._kernels.changes(
            self._tables, len(views), views[0].stride, look.x, self._change, free, look.unit, look.constant
        )
        return True

    def found_errors(self) -> dict[int, float]:
        """The squared error by W of each of these views after a look at coefficients, by number."""
        return self._errors.found()

    def close(self) -> None:
        self._slots = []  # parts of buffers, which would keep these
        super().close()


class _Attached(Owner):
    """Views, with nothing of a re-fit's own but the numbers of their splats; and a byte of what is cut for each."""

    def __init__(self, numbers: Sequence[int], subset: Subset, views: ViewSet, *_: object) -> None:
        self.nbytes = len(numbers) * views.stride + (0 if subset.numbers is None else subset.numbers.size)
        self._views = views

    def close(self) -> None:
        self._views.close()


@dataclass(frozen=True)
class _Own:
    """What a re-fit knows of a launch.

    Attributes:
        launch: the engine's.
        views: their places among all of the views that are done here.
    """

    launch: Launch[_Attached]
    views: range


@dataclass(frozen=True)
class _Gathered:
    """Launches whose sums are gathered together.

    Attributes:
        launches: they, whose views follow each other.
        free: where it stays which of the views' colours are cut; None: as views come and go, it is found anew.
    """

    launches: Sequence[_Own]
    free: int | None

    @property
    def views(self) -> range:
        """The places of all."""
        return range(self.launches[0].views.start, self.launches[-1].views.stop)


@dataclass(frozen=True)
class _Slot:
    """Where a launch that is gathered together with others has its own buffers.

    Attributes:
        change: (views, stride, 4) float32, what the launch's views composite.
        totals: (views, stride, 4) int64.
    """

    change: cl.Buffer
    totals: cl.Buffer


def _part(buffer: cl.Buffer, number: int, parts: int) -> cl.Buffer:
    """One of some equal parts of a buffer."""
    nbytes = buffer.size // parts
    return buffer if parts == 1 else buffer.get_sub_region(number * nbytes, nbytes)
