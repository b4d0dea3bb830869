"""What both kernel families are told of a sweep over pixels: :class:`PixelSums`, and macros."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.fitting.fixed_point import LARGEST_GAP, LARGEST_VALUE


@dataclass(frozen=True)
class PixelSums:
    """The sums of cl/fit/sums.clh over the pixels of some views.

    Attributes:
        views: prepared, with their geometry.
        background: R, G, B behind the splats.
        target: (pixels, 3) float32, view after view.
        first_pixel: where these views' begin.
        given: whether these are the numbers v that pixels are multiplied by; if not, v is the picture's difference to
            the target, times ``unit``.
        unit: see there.
        scale: the views' fixed point.
        totals: (views, stride, 9) int64, the sums are added to them.
    """

    views: ViewSet
    background: tuple[float, float, float]
    target: cl.Buffer
    first_pixel: int
    given: bool
    unit: float
    scale: float
    totals: cl.Buffer

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments that the kernels of both families have, by name."""
        red, green, blue = self.background
        return {
            "shapes": self.views.shapes,
            "colours": self.views.colours,
            "offsets": self.views.offsets,
            "intersections": self.views.intersections,
            "subtiles": self.views.subtiles,
            "red": red,
            "green": green,
            "blue": blue,
            "target": self.target,
            "first_pixel": self.first_pixel,
            "given": self.given,
            "unit": self.unit,
            "scale": self.scale,
            "totals": self.totals,
        }


def sums_macros(rules: RasterRules) -> dict[str, Any]:
    """Macros that the kernels of the sums need, of both families."""
    return {
        "ALPHA_CAP": float(rules.alpha_cap),
        "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold,
        "LARGEST_VALUE": LARGEST_VALUE,
        "LARGEST_GAP": LARGEST_GAP,
    }
