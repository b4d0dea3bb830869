"""From the sums that sweeps leave for each splat of a view to coefficients and blocks, cl/refit/gather.cl."""

from __future__ import annotations

from dataclasses import dataclass

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.stages.refitting.vector_space import Layout

_SOURCE = "refit/gather.cl"
#: Work-items of a work-group.
_GROUP = 64


@dataclass(frozen=True)
class Gathered:
    """The sums of some views, on the device.

    Attributes:
        totals: (views, stride, 4) int64; 0 once they are gathered.
        means: (3, stride) float32, the splats' centres.
        views: their table, ``SetView`` in cl/include/view_set.clh.
        view_count: how many they are.
        scales: float32, by what each view's sums are multiplied. first_scale: number of the first view's.
    """

    totals: cl.Buffer
    means: cl.Buffer
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
        self._layout = layout

        def kernel(name: str, constant: bool = False, weights: bool = False, some: bool = False) -> Kernel:
            return device.shared_kernel(
                _SOURCE, name, WEIGHTS=int(weights), SOME_BLOCKS=int(some), **layout.some(constant)
            )  # fmt: skip

        self._gathers = {constant: kernel("gather", constant) for constant in (False, True)}
        # A work-item of a GPU would write a whole block for each view: its blocks have a kernel of their own.
        self._blocks = kernel("gather_blocks") if layout.lanes == 1 else None
        self._with_blocks = {
            some: kernel("gather", weights=True, some=some) for some in (False, True) if self._blocks is None
        }

    def enqueue(self, gathered: Gathered, free: cl.Buffer, sums: cl.Buffer, constant: bool) -> None:
        """Enqueue: sums += what views add to coefficients.

        Args:
            gathered: of the views.
            free: (views, stride, 4) float32, whose last element tells which channels are not cut.
            sums: (3 M, stride) int64.
            constant: only those of the constant coefficients.
        """
        self._enqueue(self._gathers[constant], gathered, free, sums, sums, 0, self._layout.stride)

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
        if self._blocks is None:
            kernel = self._with_blocks[count < layout.stride]
            self._enqueue(kernel, gathered, free, sums, blocks, first_block, count)
            return
        self._blocks.bind(
            totals=gathered.totals,
            means=gathered.means,
            stride=layout.stride,
            views=gathered.views,
            view_count=gathered.view_count,
            scales=gathered.scales,
            first_scale=gathered.first_scale,
            first_block=first_block,
            block_stride=count,
            blocks=blocks,
        )
        self._blocks.launch((-(-count // _GROUP) * _GROUP, (layout.sh_count + 1) // 2), (_GROUP, 1))
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
        kernel.bind(
            totals=gathered.totals,
            means=gathered.means,
            stride=self._layout.stride,
            views=gathered.views,
            view_count=gathered.view_count,
            scales=gathered.scales,
            first_scale=gathered.first_scale,
            free=free,
            result=sums,
            first_block=first_block,
            block_stride=block_stride,
            blocks=blocks,
        )
        self._layout.over_splats(kernel)
