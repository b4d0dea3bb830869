"""The linear map A from a scene's SH coefficients to its pictures in all views, and its transpose.

For given geometry and opacities the pictures are linear in the coefficients, pictures = A x + a constant, as long as no
colour is cut at 0. Colours that are cut at some x count as constant: :meth:`ColourMap.gradient` settles at its x which
are, and :meth:`ColourMap.normal` goes by that.

A product with Aᵀ W A is one sweep over the tiles of every view (cl/refit/refit_cpu.cl, refit_gpu.cl): from the splats'
colours (cl/refit/view_colours.cl) to the pixels' values, and from those back to sums for each splat, which are gathered
into coefficients (cl/refit/gather.cl). W weighs pixels so that all views count the same whatever their size.

The sums over views are integers. So it makes no difference to any bit if other devices do some of the views
(:class:`Helpers`, which shared_map.py is): their sums are added to those of this device's views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pyopencl as cl

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import TABLE_ENTRY, ViewSet
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.fixed_point import gathered_scale
from potr_cl.stages.refitting.gathering import Gathered, Gathering
from potr_cl.stages.refitting.launcher import Launcher
from potr_cl.stages.refitting.picked_views import PickedViews
from potr_cl.stages.refitting.prepared_views import PreparedViews, SweptViews
from potr_cl.stages.refitting.reached import Reach
from potr_cl.stages.refitting.targets import TargetCache, Targets, nbytes
from potr_cl.stages.refitting.view_colours import Picks, ViewColours
from potr_cl.stages.refitting.view_errors import ViewErrors

#: Bytes a splat and view of a sweep's own buffers: the colours' change and the sums.
_CHANGE, _TOTALS = 16, 32

#: Work-items of a work-group.
_GROUP = 64
#: Views are divided into so many parts, every second one in each, where each has as many as are enough: with 62 in
#: each, steps by one part lost 0.01 dB on a captured scene, and 0.03 on its pictures a third as wide.
_PARTS, ENOUGH = 2, 80


class Helpers(Protocol):
    """Do some of the views of a :class:`ColourMap`."""

    def begin_gradient(self, x: cl.Buffer, blocks: bool, constant: bool) -> None:
        """Have them begin with :meth:`ColourMap.sum_gradient` of their views."""

    def begin_normal(self, direction: cl.Buffer, at: cl.Buffer, unit: float, constant: bool, part: int | None) -> None:
        """Have them begin with :meth:`ColourMap.sum_normal` of their views."""

    def add(self, sums: cl.Buffer, blocks: cl.Buffer | None) -> dict[int, float]:
        """Wait for them, and add what they found to the sums on this device.

        Returns:
            The errors of their views by number, after a gradient.
        """
        ...


class ColourMap(Owner):
    """A of one scene and some views, with pixels weighed by W.

    Args:
        launcher: runs the sweeps.
        rasterizer: of the scene's geometry and opacities; its colours are never looked at. It stays the caller's.
        coefficients: whose vectors the map takes and gives.
        cameras: the views that count, all the same whatever their size.
        background: R, G, B behind the splats.
        memory: bytes of device memory that prepared views and targets may take; None: two fifths of
            what is free, or a quarter where that is the host's memory.
        numbers: of the views that are done here, ascending; None: all.
        helpers: do the others.
        reach: of the views that are done here, where each has splats of its own; None: they share all splats.

    Attributes:
        sums: (3 M, stride) int64 in the device's memory, what the views have added to coefficients; 0 between products.
        parts: into how many parts views are divided, each of which shows about the same as all of them: one part where
            they are few.
        total_weight: the sum over all pixels and channels of their weights: a squared error over it is a mean one.

    Raises:
        UsageError: no camera.
        DeviceError: a view does not fit the device, or the kernels cannot be built.
    """

    def __init__(
        self,
        launcher: Launcher,
        rasterizer: Rasterizer,
        coefficients: Coefficients,
        cameras: Sequence[Camera],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
        numbers: Sequence[int] | None = None,
        helpers: Helpers | None = None,
        reach: Reach | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("a re-fit needs at least one view")
        self._helpers = helpers
        self._device = device = coefficients.device
        self._layout = layout = coefficients.layout
        self._coefficients = coefficients
        self._background = background
        self._launcher = launcher
        self._gathering = Gathering(device, layout)
        self.total_weight = 3 * REFERENCE_PIXELS * len(cameras)
        self._one = gathered_scale(cameras, [_weight(camera) for camera in cameras])
        fixed_points = self._launcher.fixed_point_scales(cameras)
        self._views_of_all = len(cameras)
        self.parts = parts_of(len(cameras))
        own_numbers = range(len(cameras)) if numbers is None else numbers
        seen = {} if reach is None else {number: len(splats) for number, splats in reach.of.items()}
        # Launches, and what is gathered together, are of one part. Views of a launch have about as many splats.
        self._numbers = sorted(own_numbers, key=lambda each: (each % self.parts, -seen.get(each, 0), each))
        of_parts = [sum(number % self.parts == part for number in own_numbers) for part in range(self.parts)]
        breaks = np.cumsum(of_parts).tolist()
        cameras = [cameras[number] for number in self._numbers]
        self._weights = [_weight(camera) for camera in cameras]
        self._fixed_points = [fixed_points[number] for number in self._numbers]
        self._memory = Memory(device)
        self._owned: list[Owner] = [self._memory]
        try:
            self._means = rasterizer.parameters.means
            self._view_colours = ViewColours(device, layout, self._means)
            # To render a picture takes many times as long as to project a view, and it takes less room.
            pictures = sum(nbytes(camera) for camera in cameras)
            own, most_views = _CHANGE + _TOTALS, launcher.most_views
            self._views: SweptViews
            if reach is not None:
                splats = [reach.of[number] for number in self._numbers]
                self._views = PickedViews(rasterizer, cameras, splats, most_views, own, memory, breaks, pictures)
            else:
                own *= layout.stride
                self._views = PreparedViews(rasterizer, cameras, most_views, own, memory, breaks, pictures)
            self._owned.append(self._views)
            launches = self._views.launches
            most = max((len(numbers) for numbers in launches), default=0)
            together = min(self._launcher.gathered, max(len(launches), 1)) if most == 1 and reach is None else 1
            self._groups: list[list[list[range]]] = [
                [some[first : first + together] for first in range(0, len(some), together)]
                for some in (
                    [numbers for numbers in launches if self._numbers[numbers[0]] % self.parts == part]
                    for part in range(self.parts)
                )
            ]
            at_once = together * max((len(each) * self._views.stride(each) for each in launches), default=0)
            self._change = self._memory.allocate(_CHANGE * at_once, "the colours' change")
            self._totals = self._memory.allocate(_TOTALS * at_once, "the re-fit's sums")
            #: Which channels of views' own splats are free: a byte a splat and view, which stays as the views may not.
            self._free: dict[range, cl.Buffer] = {}
            if reach is not None:
                for each in launches:
                    size = len(each) * self._views.stride(each)
                    self._free[each] = self._memory.allocate(size, "the channels that are cut")
            self._slots = [
                _Slot(*(_part(of, slot, together) for of in (self._change, self._totals))) for slot in range(together)
            ]
            self._tables = self._memory.allocate(TABLE_ENTRY * most * together, "the views")
            coefficients.zero(self._totals)
            self.sums = self._memory.allocate(8 * layout.columns * layout.stride, "the sums over views")
            coefficients.zero(self.sums)
            self._errors = ViewErrors(device, cameras, self._weights, self._numbers, launches)
            self._owned.append(self._errors)
            # By what each view's sums are multiplied on their way to the coefficients.
            pairs = zip(self._weights, self._fixed_points, strict=True)
            scales = np.array([self._one * weight / fixed_point for weight, fixed_point in pairs], np.float32)
            self._scales = self._memory.upload(scales, "the views' scales")
            self._targets = TargetCache(device, cameras, launches, self._views.budget, self._numbers)
            self._owned.append(self._targets)
        except BaseException:
            self.close()
            raise

    @property
    def room(self) -> float:
        """Bytes of the memory for prepared views and targets that are left."""
        return self._views.budget.room

    # ------------------------------------------------------------------------------------------ products

    def gradient(
        self,
        x: Vector,
        targets: Targets,
        result: Vector,
        blocks: SplatBlocks | None = None,
        constant: bool = False,
    ) -> float:
        """result += Aᵀ W (pictures(x) - targets), half the gradient of the squared error at x.

        Colours that are cut at 0 at x are settled: they have no part in it.

        Args:
            x: the coefficients.
            targets: what the pictures should show.
            result: a vector.
            blocks: become the splats' own blocks of Aᵀ W A; cuts are left out of account there.
            constant: leave the result's AC coefficients alone. Not together with blocks.

        Returns:
            The squared error |pictures(x) - targets|² by W.

        Raises:
            DeviceError: the device failed. What the targets raise.
        """
        ranges = [] if blocks is None else blocks.ranges
        with Memory(self._device) as memory:
            sums = self._block_sums(memory, len(ranges[0])) if ranges else None
            on_device = self._coefficients.on_device(x)
            if self._helpers is not None:
                self.prepare(targets)  # it waits for this device, from which the others then read x
                self._helpers.begin_gradient(on_device, blocks is not None, constant)
            self.sum_gradient(on_device, targets, sums, constant)
            errors = {} if self._helpers is None else self._helpers.add(self.sums, sums)
            errors |= self.found_errors()
            self._coefficients.add_fixed(result, self.sums, 1 / self._one, constant)
            if blocks is not None:
                blocks.set_fixed(ranges[0], sums, 1 / self._one)
                self._device.queue.finish()  # before their memory is given back
        for splats in ranges[1:]:
            with Memory(self._device) as memory:
                sums = self._block_sums(memory, len(splats))
                self._sum_blocks(sums, splats.start)
                assert blocks is not None
                blocks.set_fixed(splats, sums, 1 / self._one)
                self._device.queue.finish()
        return math.fsum(errors[number] for number in sorted(errors))

    def prepare(self, targets: Targets) -> None:
        """Have the pictures of this device's views that are kept there, before the first gradient asks for them.

        Raises:
            DeviceError: the device failed. What the targets raise.
        """
        self._targets.fill(targets)

    def sum_gradient(
        self,
        x: cl.Buffer,
        targets: Targets,
        blocks: cl.Buffer | None,
        constant: bool = False,
        drawn: cl.Buffer | None = None,
    ) -> None:
        """Enqueue the part of :meth:`gradient` that is a sum over this device's views: it is added to :attr:`sums`.

        Args:
            x, targets, constant: as of :meth:`gradient`.
            blocks: (M (M + 1) / 2, n) int64, the same of the first n splats' own blocks; None: they are not wanted.
            drawn: (stride,) uint8, becomes 1 for each splat that any of these views draws; not where each view has
                splats of its own. None: it is not wanted.
        """
        for group in self._groups_of(None):
            for slot, numbers in zip(self._slots, group, strict=False):
                with self._views.ready(numbers) as ready:
                    views = ready.views
                    self._view_colours.enqueue(views, self._picks(numbers), x, views.colours, None)
                    pictures = self._targets.pictures(targets, numbers)
                    self._enqueue_sweep(numbers, views, views.colours, pictures, blocks is not None, slot)
                    if drawn is not None:
                        self._enqueue_drawn(views, drawn)
                    # Which of them are cut, the gathering asks.
                    nbytes = _CHANGE * views.stride * len(numbers)
                    cl.enqueue_copy(self._device.queue, slot.change, views.colours, byte_count=nbytes)
                    self._enqueue_table(numbers, group, views)
                    self._errors.keep(numbers)
            self._enqueue_gather(group, blocks, constant)

    def found_errors(self) -> dict[int, float]:
        """The squared error by W of each of this device's views after :meth:`sum_gradient`, by number."""
        return self._errors.found()

    def _sum_blocks(self, blocks: cl.Buffer, first: int) -> None:
        """The blocks' part of :meth:`sum_gradient` alone, of the splats from one on."""
        self._coefficients.zero(self._change)  # black, and no channel is free
        for group in self._groups_of(None):
            for slot, numbers in zip(self._slots, group, strict=False):
                with self._views.ready(numbers) as ready:
                    self._enqueue_sweep(numbers, ready.views, slot.change, None, True, slot)
                    self._enqueue_table(numbers, group, ready.views)
            self._enqueue_gather(group, blocks, False, first)

    def normal(
        self, direction: Vector, at: Vector, result: Vector, constant: bool = False, part: int | None = None
    ) -> None:
        """result += Aᵀ W A direction, nothing if the direction is 0 or not finite.

        Args:
            direction: a vector. It may be of any length: it is scaled so that the fixed point of the sums fits.
            at: the vector that :meth:`gradient` was given last, with the same content.
            result: another vector.
            constant: the direction's AC coefficients are all 0, and those of the result are left alone.
            part: number of the part of the views that stands for all of them, modulo :attr:`parts`. None: all.

        Raises:
            DeviceError: the device failed.
        """
        part = None if part is None else part % self.parts
        largest = self._coefficients.largest(direction)
        if not 0 < largest < math.inf:
            return
        unit = 1 / largest
        on_device = self._coefficients.on_device(direction)
        if self._helpers is not None:
            assert isinstance(at, cl.Buffer), "several devices have their vectors on the master's device"
            self._helpers.begin_normal(on_device, at, unit, constant, part)
        self.sum_normal(on_device, at, unit, constant, part)
        if self._helpers is not None:
            self._helpers.add(self.sums, None)
        share = 1.0 if part is None else len(range(part, self._views_of_all, self.parts)) / self._views_of_all
        self._coefficients.add_fixed(result, self.sums, 1 / (self._one * unit * share), constant)

    def sum_normal(
        self, direction: cl.Buffer, at: Vector, unit: float, constant: bool = False, part: int | None = None
    ) -> None:
        """The part of :meth:`normal` that is a sum over this device's views: it is added to :attr:`sums`.

        Args:
            direction, at, constant, part: as of :meth:`normal`; the direction on the device.
            unit: the direction is multiplied by this.
        """
        for group in self._groups_of(part):
            for slot, numbers in zip(self._slots, group, strict=False):
                with self._views.ready(numbers) as ready:
                    views, picks = ready.views, self._picks(numbers)
                    if ready.anew and picks is None:  # which colours are cut is not known any more
                        at_here = self._coefficients.on_device(at, 1)
                        self._view_colours.enqueue(views, picks, at_here, views.colours, None)
                    self._view_colours.enqueue(views, picks, direction, slot.change, unit, constant)
                    self._enqueue_sweep(numbers, views, slot.change, None, False, slot)
                    self._enqueue_table(numbers, group, views)
            self._enqueue_gather(group, None, constant)

    # ------------------------------------------------------------------------------------------ their parts

    def _groups_of(self, part: int | None) -> list[list[range]]:
        """The launches that are gathered together, of a part of the views or of all."""
        return [group for groups in self._groups for group in groups] if part is None else self._groups[part]

    def _block_sums(self, memory: Memory, splats: int) -> cl.Buffer:
        """Integers for the blocks of so many splats, 0."""
        triangle = self._layout.sh_count * (self._layout.sh_count + 1) // 2
        sums = memory.allocate(8 * triangle * splats, "the splats' normal equations")
        self._coefficients.zero(sums)
        return sums

    def _picks(self, numbers: range) -> Picks | None:
        """The splats of a launch's views, which are ready, and which of their channels are free."""
        picks = self._views.picks(numbers)
        return None if picks is None else Picks(picks, self._free[numbers])

    def _enqueue_sweep(
        self,
        numbers: range,
        views: ViewSet,
        colours: cl.Buffer,
        target: cl.Buffer | None,
        weights: bool,
        slot: _Slot,
    ) -> None:
        """Enqueue the sweep of a launch's views; without a target colours are a change, and black is behind them."""
        self._launcher.sweep(
            views,
            views.stride,
            colours,
            (0.0, 0.0, 0.0) if target is None else self._background,
            target,
            self._fixed_points[numbers[0]],
            self._errors.latest,
            slot.totals,
            weights,
        )

    def _enqueue_drawn(self, views: ViewSet, drawn: cl.Buffer) -> None:
        """Enqueue: mark what views draw."""
        kernel = self._device.shared_kernel("refit/drawn.cl", "mark_drawn")
        for number, view in enumerate(views.views):
            kernel.bind(
                views=views.table,
                number=number,
                offsets=views.offsets,
                intersections=views.intersections,
                marks=drawn,
            )
            kernel.launch((-(-view.tiles // _GROUP) * _GROUP,), (_GROUP,))

    def _enqueue_table(self, numbers: range, group: Sequence[range], views: ViewSet) -> None:
        """Enqueue a launch's part of the table of the views that are gathered together."""
        start = TABLE_ENTRY * (numbers[0] - group[0][0])
        nbytes = TABLE_ENTRY * len(numbers)
        cl.enqueue_copy(self._device.queue, self._tables, views.table, byte_count=nbytes, dst_offset=start)

    def _enqueue_gather(
        self, group: Sequence[range], blocks: cl.Buffer | None, constant: bool, first_block: int = 0
    ) -> None:
        """Enqueue the way from the sums of some launches' views, which follow each other, to the coefficients.

        And to the blocks, if the sums have their part: of as many splats as there is room for, from the first one on.
        """
        gathered = Gathered(
            self._totals,
            self._means,
            self._views.stride(group[0]),
            self._views.picks(group[0]),
            self._tables,
            sum(map(len, group)),
            self._scales,
            group[0][0],
        )
        if blocks is not None:
            self._gathering.with_blocks(gathered, self._change, self.sums, blocks, first_block)
        else:
            self._gathering.enqueue(gathered, self._change, self.sums, constant)

    def close(self) -> None:
        """Give all device memory back."""
        self._slots = []  # parts of buffers, which would keep these
        for owner in reversed(self._owned):
            owner.close()


@dataclass(frozen=True)
class _Slot:
    """Where a launch that is gathered together with others has its own buffers.

    Attributes:
        change: (views, stride, 4) float32, what the launch's views composite, or its w.
        totals: (views, stride, 4) int64.
    """

    change: cl.Buffer
    totals: cl.Buffer


def parts_of(views: int) -> int:
    """Into how many parts so many views are divided; view k is in part k modulo this."""
    return _PARTS if views >= _PARTS * ENOUGH else 1


def _part(buffer: cl.Buffer, number: int, parts: int) -> cl.Buffer:
    """One of some equal parts of a buffer."""
    nbytes = buffer.size // parts
    return buffer if parts == 1 else buffer.get_sub_region(number * nbytes, nbytes)


def _weight(camera: Camera) -> float:
    """What a pixel of a view counts."""
    return REFERENCE_PIXELS / (camera.width * camera.height)
