"""What kernels do with views in a re-fit: from coefficients to splats' colours (:class:`ViewKernels`), from these to
the pixels' values and to sums for each splat (:class:`RefitSweep`), and from the sums to coefficients.

The sums over a view's pixels are integers, so that the bits are the same on every run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.rules import INRIA
from potr_cl.raster.sweep import TileSweep, fixed_point_scale, padded_area
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.refitting.sliced_arrays import Layout

#: Pixel values beyond this are cut in the kernels (macro LARGEST_VALUE of cl/refit/refit.clh): no sum can overflow.
LARGEST_VALUE = 64.0


def gathered_scale(cameras: Sequence[Camera], weights: Sequence[float]) -> float:
    """What the sums over all views are multiplied by: the largest power of two with which 62 bits suffice.

    A view adds to a coefficient at most three channels' sums, as no SH basis function is above 1.

    Args:
        cameras: all views.
        weights: what a pixel of each counts.
    """
    areas = [padded_area(camera.width, camera.height) for camera in cameras]
    bound = 3 * LARGEST_VALUE * math.fsum(weight * area for weight, area in zip(weights, areas, strict=True))
    return float(2.0 ** math.floor(62 - math.log2(bound)))


#: On CPUs, launches that are given colours, and whose sums are gathered, together: coefficients, which take much more
#: than what is a view's, go through the memory once for so many views.
TOGETHER = 8
#: On CPUs, splats of a tile that are done together. What they leave behind still fits the second cache; a longer list
#: is walked twice. With 1024, that would be a third of lego's.
_SEGMENT = 1536


class RefitSweep:
    """From the splats' colours to the pixels' values, and from those to sums for each splat, on one device.

    Args:
        device: to run on.

    Attributes:
        lanes: splats a work-item, in kernels that go over splats.
        most_views: that a launch can do.
        gathered: launches whose sums are gathered together, where each does one view.
    """

    def __init__(self, device: Device) -> None:
        self._gpu = device.family == "gpu"
        of_family = {} if self._gpu else {"SEGMENT": _SEGMENT}
        self._sweeps = [
            TileSweep(
                device, INRIA, "refit/refit", "refit_sweep", LARGEST_VALUE=LARGEST_VALUE, WEIGHTS=weights, **of_family
            )
            for weights in (0, 1)
        ]
        self.lanes, self.most_views = self._sweeps[0].lanes, self._sweeps[0].most_views
        self.gathered = TOGETHER if self.most_views == 1 else 1

    def fixed_point_scales(self, cameras: Sequence[Camera]) -> list[float]:
        """What the sums of each view are multiplied by (:func:`potr_cl.raster.sweep.fixed_point_scale`).

        Args:
            cameras: all views; those that a launch does have one scale.
        """
        if self.most_views == 1:
            return [fixed_point_scale(camera.width, camera.height, LARGEST_VALUE) for camera in cameras]
        # With it no view can overflow, whichever a launch does together.
        width, height = max(c.width for c in cameras), max(c.height for c in cameras)
        return [fixed_point_scale(width, height, LARGEST_VALUE)] * len(cameras)

    def run(
        self,
        views: ViewSet,
        shapes: cl.Buffer,
        colours: cl.Buffer,
        background: tuple[float, float, float],
        target: cl.Buffer | None,
        scale: float,
        numbers: cl.Buffer,
        first: int,
        every: int,
        back: bool,
        errors: cl.Buffer,
        totals: cl.Buffer,
        weights: bool,
        stay: bool,
    ) -> None:
        """Enqueue it.

        Args:
            views, shapes, colours, background: as of :meth:`TileSweep.run`.
            target: (pixels, 3) float32, view after view: subtracted from the pixels; None: nothing is.
            scale: the views' fixed point.
            numbers: uint32, of views among all. first: place there of the first of these.
            every: of so many blocks of pixels one is looked at (cl/refit/samples.clh), 1, 2 or 4; on GPUs not with a
                target or a background, for which other blocks' errors would count.
            back: whether sums are wanted, and not only errors.
            errors: (tiles,) float32, becomes each tile's sum of squared pixel values.
            totals: (views, stride, 4) int64: weight times value, three channels, and the squared weights are added.
            weights: sum up the squared weights too.
            stay: whether the views will be looked at again as they are: with the weights known, lists lose on CPUs
                what lies behind the ends of all pixels.
        """
        self._sweeps[weights].run(
            views,
            shapes,
            colours,
            background,
            target=colours if target is None else target,
            has_target=target is not None,
            scale=scale,
            numbers=numbers,
            first_number=first,
            every=every,
            back=back,
            errors=errors,
            totals=totals,
            **({} if self._gpu else {"trim": weights and stay}),
        )


#: Work-items of a work-group.
_GROUP = 64
#: Views that a work-item gives colours one after the other, the coefficients in its registers.
_TOGETHER = 8


@dataclass(frozen=True)
class Free:
    """Which channels were not cut at 0 when views' colours were made.

    Attributes:
        buffer: (…) uint8.
        first: where the (views, stride) of some views begin.
    """

    buffer: cl.Buffer
    first: int


@dataclass(frozen=True)
class SweptSums:
    """What sweeps have left for some views that follow each other.

    Attributes:
        totals: (views, stride, 4) int64; 0 once they are gathered.
        free: of the views.
        stride: room for the splats of each view.
        picks: (views, stride) uint32, the splats' numbers; None: all views have all, in their order.
        tables: of the views, ``SetView`` in cl/include/view_set.clh.
        views: their numbers among those that have scales.
    """

    totals: cl.Buffer
    free: Free
    stride: int
    picks: cl.Buffer | None
    tables: cl.Buffer
    views: range


class ViewKernels:
    """The kernels of one layout.

    Args:
        device: to compute on.
        layout: of the coefficients.
        means: (3, stride) float32, the splats' centres on the device.
        active: (2, stride) uint32, the flags of the coefficients that may change, there: on CPUs, where none of some
            neighbours may, sums for it stay 0, and nobody looks for it in a direction.
        scales: float32, by what each view's sums are multiplied on their way to the coefficients.
    """

    def __init__(self, device: Device, layout: Layout, means: cl.Buffer, active: cl.Buffer, scales: cl.Buffer) -> None:
        self._device, self._layout, self._means, self._active, self._scales = device, layout, means, active, scales

    def colour(
        self,
        views: ViewSet,
        picks: cl.Buffer | None,
        x: cl.Buffer,
        result: cl.Buffer,
        free: Free,
        unit: float | None = None,
        constant: bool = False,
    ) -> None:
        """Enqueue the views' colours, or what ``unit`` times a direction adds to them where none is cut at 0.

        Args:
            views: prepared.
            picks: (views, stride) uint32, numbers of the views' own splats; None: they have all.
            x: (3 M, stride of the layout) float32, the coefficients or the direction.
            result: (views, stride, 4) float32.
            free: is told by coefficients, and asked for a direction.
            unit: of the direction; None: x are coefficients.
            constant: the direction's other coefficients are 0.
        """
        kernel = self._device.shared_kernel(
            "refit/view_colours.cl", "view_colours", PICKED=int(picks is not None), **self._layout.some(constant)
        )
        kernel.bind(
            coefficients=x,
            means=self._means,
            stride=self._layout.stride,
            apart=views.stride,
            numbers=views.table if picks is None else picks,
            views=views.table,
            view_count=len(views.views),
            direction=unit is not None,
            unit=np.float32(1.0 if unit is None else unit),
            free=free.buffer,
            first_free=free.first,
            colours=result,
        )
        together = _TOGETHER if picks is None else 1
        kernel.launch(*self._layout.items(views.stride, -(-len(views.views) // together)))

    def changes(
        self, tables: cl.Buffer, count: int, stride: int, x: cl.Buffer, result: cl.Buffer, free: Free, unit: float,
        constant: bool,
    ) -> None:  # fmt: skip
        """Enqueue what a direction adds to the colours of some views on a CPU, each prepared for itself.

        To bring the direction from memory takes most of the time, and they have it once.

        Args:
            tables: of the views. count: of them. stride: of their splats, which are all.
            x, unit, constant, free: as of :meth:`colour`.
            result: (views, stride, 4) float32.
        """
        kernel = self._device.shared_kernel(
            "refit/view_colours.cl", "colour_changes", PICKED=0, **self._layout.some(constant)
        )
        kernel.bind(
            coefficients=x,
            means=self._means,
            active=self._active,
            stride=self._layout.stride,
            apart=stride,
            views=tables,
            view_count=count,
            unit=np.float32(unit),
            free=free.buffer,
            first_free=free.first,
            colours=result,
        )
        kernel.launch(*self._layout.items(stride, 1))

    def mark_drawn(self, views: ViewSet, drawn: cl.Buffer) -> None:
        """Enqueue: (stride,) uint8 become 1 for each splat that any of some views draws, which have all splats."""
        kernel = self._device.shared_kernel("refit/drawn.cl", "mark_drawn")
        for number, view in enumerate(views.views):
            kernel.bind(
                views=views.table, number=number, offsets=views.offsets, intersections=views.intersections, marks=drawn
            )
            kernel.launch((-(-view.tiles // _GROUP) * _GROUP,), (_GROUP,))

    def gather(
        self,
        found: SweptSums,
        sums: cl.Buffer,
        constant: bool = False,
        blocks: cl.Buffer | None = None,
        first_block: int = 0,
    ) -> None:
        """Enqueue: sums += what views add to coefficients, blocks += what they add to the splats' own blocks.

        Args:
            found: of the views; for blocks, the sums of squared weights are there too.
            sums: (3 M, stride) int64.
            constant: only those of the constant coefficients; not together with blocks.
            blocks: (M (M + 1) / 2, n) int64, of n splats; None: they are not wanted.
            first_block: number of the first of them.
        """
        layout = self._layout
        own = {"first_block": 0, "block_stride": layout.stride, "blocks": sums}
        weights = some = 0
        if blocks is not None:
            of_blocks = {
                "first_block": first_block, "block_stride": blocks.size // (8 * layout.triangle), "blocks": blocks,
            }  # fmt: skip
            if layout.lanes > 1:
                own, weights, some = of_blocks, 1, int(of_blocks["block_stride"] < layout.stride)
            else:
                # A work-item of a GPU would write a whole block for each view: its blocks have a kernel of their own.
                self._gather_blocks(found, of_blocks)
        kernel = self._kernel("gather", found, WEIGHTS=weights, SOME_BLOCKS=some, **layout.some(constant))
        items = layout.items(found.stride)
        free = {"free": found.free.buffer, "first_free": found.free.first}
        for arguments in self._arguments(found):
            kernel.bind(**arguments, **own, **free, active=self._active, result=sums).launch(*items)

    def _gather_blocks(self, found: SweptSums, blocks: dict[str, Any]) -> None:
        kernel = self._kernel("gather_blocks", found, WEIGHTS=0, SOME_BLOCKS=0, **self._layout.macros)
        splats = blocks["block_stride"] if found.picks is None else found.stride
        items = -(-splats // _GROUP) * _GROUP, (self._layout.sh_count + 1) // 2
        for arguments in self._arguments(found):
            kernel.bind(**arguments, **blocks).launch(items, (_GROUP, 1))

    def _kernel(self, name: str, found: SweptSums, **macros: int) -> Kernel:
        return self._device.shared_kernel("refit/gather.cl", name, PICKED=int(found.picks is not None), **macros)

    def _arguments(self, found: SweptSums) -> list[dict[str, Any]]:
        """For views that may add to splats at the same time: all, where a work-item has the same splat in all."""
        count = len(found.views)
        return [
            {
                "totals": found.totals,
                "means": self._means,
                "stride": self._layout.stride,
                "apart": found.stride,
                "numbers": found.tables if found.picks is None else found.picks,
                "views": found.tables,
                "first_view": some.start,
                "view_count": len(some),
                "scales": self._scales,
                "first_scale": found.views.start,
            }
            for some in ([range(count)] if found.picks is None else [range(n, n + 1) for n in range(count)])
        ]
