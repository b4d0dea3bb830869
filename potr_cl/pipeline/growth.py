"""How size and PSNR grow with q: what a search knows before it has encoded anything, and how it goes on from points.

:class:`Typical` has the figures of a typical scene, :func:`meet` finds where a growing function reaches its aim. The
other names change how fine the quantiser is without changing anything else.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import Preset
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.code import Code
from potr_cl.stages.stage import parameters

#: Qualities, and what they give in a typical scene: bytes a splat of the source, and PSNR in decibels. Means of two
#: scenes (docs/benchmarks/rate_distortion.md), less sure below 0.1. Above all the rate of growth matters.
_TYPICAL_Q = (0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1)
_TYPICAL: dict[Preset, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "paper": (
        (0.77, 2.01, 2.97, 4.1, 6.2, 8.3, 10.1, 11.9, 13.7, 15.3, 17.0, 18.7, 20.4),
        (9.7, 29.7, 34.2, 35.7, 38.2, 39.7, 41.2, 42.8, 44.3, 45.6, 46.6, 47.9, 48.6),
    ),
    "fast": (
        (2.23, 2.34, 2.52, 2.83, 3.58, 4.52, 5.56, 6.76, 8.21, 9.82, 11.63, 13.81, 16.19),
        (35.3, 35.7, 36.2, 37.2, 38.8, 40.5, 42.3, 44.0, 45.7, 47.5, 49.4, 51.2, 53.0),
    ),
    "best": (
        (1.91, 2.00, 2.15, 2.42, 3.08, 3.90, 4.83, 5.90, 7.21, 8.66, 10.26, 12.19, 14.28),
        (35.7, 36.1, 36.7, 37.6, 39.3, 41.0, 42.7, 44.5, 46.3, 48.0, 49.7, 51.5, 53.3),
    ),
}
_TYPICAL["smallest"] = _TYPICAL["best"]
#: Bounds of a measured rate, as parts of the typical one, beyond the places that are known.
SLOWEST, FASTEST = 0.25, 3.0


class Typical:
    """Size or PSNR of a typical scene for each q, and the q for each of these: :meth:`sizes`, :meth:`psnrs`."""

    def __init__(self, values: NDArray[np.float64]) -> None:
        self._values = values

    @staticmethod
    def sizes(preset: Preset, splats: float) -> Typical:
        """Logarithms of the file's bytes, for a scene of so many splats."""
        return Typical(np.log(_TYPICAL[preset][0]) + math.log(splats))

    @staticmethod
    def psnrs(preset: Preset) -> Typical:
        """Decibels."""
        return Typical(np.array(_TYPICAL[preset][1]))

    def value(self, q: float) -> float:
        """Of a quality from 0 to 1."""
        return float(np.interp(q, _TYPICAL_Q, self._values))

    def quality(self, value: float) -> float:
        """The nearest q from 0 to 1, rounded to what matters."""
        return round(float(np.interp(value, self._values, _TYPICAL_Q)), 5)


class FinenessAxis:
    """Qualities by the logarithm of the quantiser's fineness."""

    def __init__(self, options: EncodeOptions) -> None:
        self._options = options.changed(code={"sf_sh": None})

    def fineness(self, q: float) -> float:
        """Of a quality from 0 to 1."""
        return math.log(self._options.changed(q=q).parameters.sf_sh)

    def quality(self, fineness: float) -> float:
        """The nearest q from 0 to 1, rounded to what matters."""
        low, high = 0.0, 1.0
        for _ in range(20):
            middle = (low + high) / 2
            low, high = (middle, high) if self.fineness(middle) < fineness else (low, middle)
        return round(high if fineness > self.fineness(0) else 0.0, 5)


def with_steps(options: EncodeOptions, q: float) -> EncodeOptions:
    """The options with the quantiser's parameters of another q, as far as they are not given on their own."""
    wanted = options.changed(q=q).parameters
    return options.with_parameters(**{name: getattr(wanted, name) for name in parameters(Code)})


def with_colour_steps(options: EncodeOptions, given: EncodeOptions, finer: float) -> EncodeOptions:
    """The options with steps of colours that are finer by a factor, given by its logarithm, unless they are given."""
    names = [name for name in ("sf_dc", "sf_sh") if getattr(given.code, name) is None]
    return options.with_parameters(**{name: getattr(options.parameters, name) * math.exp(finer) for name in names})


def meet(points: dict[float, float], aim: float, rate: float) -> float:
    """Where a growing function, known at some points, probably reaches the aim.

    Args:
        points: known values by place; at least one.
        rate: how fast the function typically grows. It is used if the aim does not lie between known values.
    """
    places = sorted(points)
    rising = [(b - a, a, b) for a, b in itertools.pairwise(places) if points[a] < aim <= points[b]]
    if rising:
        _, a, b = min(rising)
        return a + (b - a) * (aim - points[a]) / (points[b] - points[a])
    # Beyond all that is known; values that do not grow everywhere may lie on both sides.
    if points[places[0]] < aim:
        places.reverse()
    edge, *others = places
    if others:
        measured = (points[others[0]] - points[edge]) / (others[0] - edge)
        rate *= min(max(measured / rate, SLOWEST), FASTEST)
    return edge + (aim - points[edge]) / rate
