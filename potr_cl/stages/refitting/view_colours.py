"""From coefficients to the splats' colours in views, cl/refit/view_colours.cl: :class:`ViewColours`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.refitting.layout import Layout

#: Views that a work-item does one after the other, the coefficients in its registers.
_TOGETHER = 8


@dataclass(frozen=True)
class Picks:
    """Views' own splats.

    Attributes:
        numbers: (views, stride) uint32, their numbers.
        free: (views, stride) uint8, which channels were not cut when the views' colours were made.
    """

    numbers: cl.Buffer
    free: cl.Buffer


class ViewColours:
    """The kernels of one layout.

    Args:
        device: to compute on.
        layout: of the coefficients.
        means: (3, stride) float32, the splats' centres on the device.
    """

    def __init__(self, device: Device, layout: Layout, means: cl.Buffer) -> None:
        self._device, self._layout, self._means = device, layout, means

    def enqueue(
        self,
        views: ViewSet,
        picks: Picks | None,
        x: cl.Buffer,
        result: cl.Buffer,
        unit: float | None,
        constant: bool = False,
    ) -> None:
        """Enqueue the views' colours, or what ``unit`` times a direction adds to them where none is cut at 0.

        Args:
            views: with their colours at the coefficients, if a direction is looked along and they have all splats.
            picks: the views' own splats; None: they have all.
            x: (3 M, stride of the layout) float32, the coefficients or the direction.
            result: (views, stride, 4) float32.
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
            numbers=views.table if picks is None else picks.numbers,
            views=views.table,
            view_count=len(views.views),
            direction=unit is not None,
            unit=np.float32(1.0 if unit is None else unit),
            free=views.colours,
            free_picks=views.table if picks is None else picks.free,
            colours=result,
        )
        together = _TOGETHER if picks is None else 1
        self._layout.over_splats(kernel, -(-len(views.views) // together), stride=views.stride)
