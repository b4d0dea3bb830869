"""The quantisers that a file can have been made with, one class each: :data:`QUANTISERS`.

A quantiser says what integers are made of a scene's values and what values are made of the integers again: widths of
steps, rotations, opacities, the octree's leaf levels; scales are quantised alike by all. Everything else that reads or
writes files asks it and never compares its number. docs/format.md is the normative description. Which one is taken
follows from the hyper-parameters (:class:`potr_cl.codec.quantize.HyperParameters`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.quantize import F32, F64, HyperParameters, Integers
from potr_cl.host.threads import Run
from potr_cl.model.scene import Scene

#: Numbers that a sample has; fewer are left to NumPy.
_SAMPLE = 1 << 14
#: Of the sample, to either side of its middle: six standard deviations of where the median of all lies in it.
_MARGIN = 3 * 128


def median(values: NDArray[np.float64]) -> float | None:
    """The median of (n,) float64, none of which is not a number; None of none.

    A sample says roughly where it is; only what lies there is looked at closely.
    """
    n = len(values)
    if n == 0:
        return None
    if n > 4 * _SAMPLE:
        sample = np.sort(values[:: n // _SAMPLE])
        middle = len(sample) // 2
        low, high = sample[middle - _MARGIN], sample[middle + _MARGIN]
        near = values[(values >= low) & (values <= high)]
        below = np.count_nonzero(values < low)
        first, last = (n - 1) // 2 - below, n // 2 - below
        if first >= 0 and last < len(near):
            near.partition((first, last))
            return float((near[first] + near[last]) / 2) if first != last else float(near[first])
    return float(np.median(values))


Levels = NDArray[np.integer]

#: How many times as many steps the scales of antialiased scenes have, with :class:`Balanced`.
ANTIALIASED_SCALE_STEPS = 2


class Paper:
    """The paper's: uniform steps of every activated value, lengths in world units.

    Attributes:
        number: that stands in the file.
        absolute_leaf_levels: whether the levels of leaves are chosen by the tolerance alone (``absolute`` of
            :func:`potr_cl.codec.octree.build`).
        colour_steps: whether a file may give each splat the steps of its colours (:mod:`potr_cl.codec.steps`); and
            whether coder BUNDLES is for it.
    """

    number = 0
    absolute_leaf_levels = False
    colour_steps = False

    def in_world_units(
        self, parameters: HyperParameters, scene: Scene, nearest: F64, run: Run = map
    ) -> HyperParameters:
        """Hyper-parameters whose β is a part of the distance to the nearest camera, and γ and SF_scale in world units.

        Args:
            parameters: as asked for.
            scene: that is to be coded.
            nearest: (N,) float64 distance of each splat to the nearest view, world units; 0 where there is no view.
            run: in place of :func:`map`, to work with several threads.
        """
        return parameters

    def quantize_rotations(
        self, imaginary: F64, scales: Sequence[Levels], sf_rotation: float, run: Run
    ) -> Iterable[Integers]:
        """(N, 3) imaginary parts of unit quaternions to levels of x, y and z, (N,) each; ``scales`` as quantised."""
        return run(lambda part: quantize.quantize_rotations(part, sf_rotation), imaginary.T)

    @staticmethod
    def rotation_factors(scales: Sequence[Levels], sf_rotation: float) -> F32:
        """Scale factors of :func:`potr_cl.codec.quantize.dequantize_rotations`, float32: (N,), or (1,) if all are one.

        Args:
            scales: levels of the scales, (N,) for each axis.
            sf_rotation: scale factor.
        """
        return np.full(1, sf_rotation, np.float32)

    quantize_opacities = staticmethod(quantize.quantize_opacities)
    dequantize_opacities = staticmethod(quantize.dequantize_opacities)


class Balanced:
    """Steps of equal worth: finer rotations for longer splats, opacities as logits, lengths in sizes of a splat.

    What it offers is that of :class:`Paper`.
    """

    number = 1
    absolute_leaf_levels = True
    colour_steps = True

    def in_world_units(
        self, parameters: HyperParameters, scene: Scene, nearest: F64, run: Run = map
    ) -> HyperParameters:
        """β and SF_scale are given in sizes of a typical splat, so that the scene's unit of length does not matter.

        A splat's size is its largest standard deviation, the typical one their median; seen from the views, the median
        of size over distance.

        Scales of antialiased scenes have finer steps: their splats' opacity follows the area on screen, so that an
        error in a thin splat's width is seen as one in its opacity.
        """
        sizes, seen = np.empty(len(nearest)), np.empty(len(nearest))

        def look(start: int) -> None:
            rows = slice(start, start + _ROWS)
            first, second, third = scene.log_scales[rows].T
            largest = np.maximum(np.maximum(first, second), third)
            np.exp(np.clip(largest.astype(np.float64), -60, 60), out=sizes[rows])
            with np.errstate(divide="ignore"):  # where there is no view
                np.divide(sizes[rows], nearest[rows], out=seen[rows])

        list(run(look, range(0, len(nearest), _ROWS)))
        whole = bool((nearest > 0).all())
        size, ratio = run(median, (sizes, seen if whole else seen[nearest > 0]))
        assert size is not None  # there is a splat
        finer = ANTIALIASED_SCALE_STEPS if scene.antialiased else 1
        sf_scale = min(max(finer * parameters.sf_scale / size, 1e-3), 1e9)
        if ratio is not None:
            return replace(parameters, beta=parameters.beta * ratio, sf_scale=sf_scale)
        return replace(parameters, gamma=max(parameters.gamma, parameters.beta * size), sf_scale=sf_scale)

    def quantize_rotations(
        self, imaginary: F64, scales: Sequence[Levels], sf_rotation: float, run: Run
    ) -> Iterable[Integers]:
        factors = self.rotation_factors(scales, sf_rotation)
        # A splat that is decoded as a ball has no direction.
        ball = (scales[0] == scales[1]) & (scales[1] == scales[2])
        return run(lambda part: np.where(ball, 0, quantize.quantize_rotations(part, factors)), imaginary.T)

    rotation_factors = staticmethod(quantize.rotation_factors)
    quantize_opacities = staticmethod(quantize.quantize_logits)
    dequantize_opacities = staticmethod(quantize.dequantize_logits)


#: Splats worked on at a time.
_ROWS = 1 << 15


Quantiser: TypeAlias = Paper | Balanced
#: All of them, by their number.
QUANTISERS: dict[int, Quantiser] = {quantiser.number: quantiser for quantiser in (Paper(), Balanced())}
