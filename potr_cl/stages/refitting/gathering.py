"""From the sums that sweeps leave for each splat of a view to coefficients and blocks, cl/refit/gather.cl."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.stages.refitting.layout import Layout

_SOURCE = "refit/gather.cl"
#: Work-items of a work-group.
_GROUP = 64


@dataclass(frozen=True)
class Gathered:
    """The sums of some views, on the device.

    Attributes:
        totals: (views, stride, 4) int64; 0 once they are gathered.
        means: (3, stride) float32, the splats' centres.
        stride: room for the splats of each view.
        picks: (views, stride) uint32, the splats' numbers; None: all views have all, in their order.
        views: their table, ``SetView`` in cl/include/view_set.clh.
        view_count: how many they are.
        scales: float32, by what each view's sums are multiplied. first_scale: number of the first view's.
    """

    totals: cl.Buffer
    means: cl.Buffer
    stride: int
    picks: cl.Buffer | None
    views: cl.Buffer
    view_count: int
    scales: cl.Buffer
    first_scale: int


class Gathering:
    """The kernels of one layout.

    Args:
        device: to compute on.
        layout: of the coefficients.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self._layout, self._device = layout, device
        # A work-item of a GPU would write a whole block for each view: its blocks have a kernel of their own.
        self._apart = layout.lanes == 1

    def _kernel(self, name: str, gathered: Gathered, **macros: int) -> Kernel:
        return self._device.shared_kernel(_SOURCE, name, PICKED=int(gathered.picks is not None), **macros)

    def enqueue(self, gathered: Gathered, free: cl.Buffer, sums: cl.Buffer, constant: bool) -> None:
        """Enqueue: sums += what views add to coefficients.

        Args:
            gathered: of the views.
            free: (views, stride, 4) float32, whose last element tells which channels are not cut.
            sums: (3 M, stride) int64.
            constant: only those of the constant coefficients.
        """
        kernel = self._kernel("gather", gathered, WEIGHTS=0, SOME_BLOCKS=0, **self._layout.some(constant))
        self._enqueue(kernel, gathered, free, sums, sums, 0, self._layout.stride)

    def with_blocks(
        self, gathered: Gathered, free: cl.Buffer, sums: cl.Buffer, blocks: cl.Buffer, first_block: int
    ) -> None:
        """The same, and enqueue blocks += what views add to them.

        Args:
            gathered, free, sums: as :meth:`enqueue` takes them; the sums of squared weights are there too.
            blocks: (M (M + 1) / 2, n) int64, of n splats.
            first_block: number of the first of them.
        """
        layout = self._layout
        count = blocks.size // (8 * (layout.sh_count * (layout.sh_count + 1) // 2))
        if not self._apart:
            some = int(count < layout.stride)
            kernel = self._kernel("gather", gathered, WEIGHTS=1, SOME_BLOCKS=some, **layout.macros)
            self._enqueue(kernel, gathered, free, sums, blocks, first_block, count)
            return
        kernel = self._kernel("gather_blocks", gathered, WEIGHTS=0, SOME_BLOCKS=0, **layout.macros)
        for views in self._together(gathered):
            kernel.bind(**self._arguments(gathered, views), first_block=first_block, block_stride=count, blocks=blocks)
            items = count if gathered.picks is None else gathered.stride
            kernel.launch((-(-items // _GROUP) * _GROUP, (layout.sh_count + 1) // 2), (_GROUP, 1))
        self.enqueue(gathered, free, sums, False)

    def _enqueue(
        self,
        kernel: Kernel,
        gathered: Gathered,
        free: cl.Buffer,
        sums: cl.Buffer,
        blocks: cl.Buffer,
        first_block: int,
        block_stride: int,
    ) -> None:
        for views in self._together(gathered):
            kernel.bind(
                **self._arguments(gathered, views),
                free=free,
                result=sums,
                first_block=first_block,
                block_stride=block_stride,
                blocks=blocks,
            )
            self._layout.over_splats(kernel, stride=gathered.stride)

    def _together(self, gathered: Gathered) -> Iterator[range]:
        """Views that may add to splats at the same time: all, where a work-item has the same splat in all of them."""
        if gathered.picks is None:
            yield range(gathered.view_count)
        else:
            for number in range(gathered.view_count):
                yield range(number, number + 1)

    def _arguments(self, gathered: Gathered, views: range) -> dict[str, Any]:
        return {
            "totals": gathered.totals,
            "means": gathered.means,
            "stride": self._layout.stride,
            "apart": gathered.stride,
            "numbers": gathered.views if gathered.picks is None else gathered.picks,
            "views": gathered.views,
            "first_view": views.start,
            "view_count": len(views),
            "scales": gathered.scales,
            "first_scale": gathered.first_scale,
        }
