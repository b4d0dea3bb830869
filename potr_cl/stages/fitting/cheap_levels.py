"""Levels that take fewer bits where nobody sees the difference: :func:`with_cheap_levels`.

Some splats' opacities and scales hardly show: behind others, far beyond what makes a splat opaque, along the thin side
of a flat one. To the nearest level they are rounded for nothing where a usual one will do as well. So each is given the
level of least cost: the squared error it makes, and the bits that the level takes by how often it is used, at the price
that a bit has elsewhere in the file (rate-distortion optimised quantisation).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.geometry import Geometry
from potr_cl.codec.quantize import LEAST_LOGIT, RANGE_OF_LOGITS, ZERO_SCALE, Integers, canonical_rotations, level_type
from potr_cl.codec.versions import VERSIONS
from potr_cl.model.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

#: How many levels below and above the nearest are tried, and how often, each time with what levels take by then.
_SPAN, _ROUNDS = 4, 2
#: Levels from here on, of splats unlike the others, stay the nearest.
_MOST = 1 << 12
#: A level that nobody uses yet is counted as so often used.
_UNUSED = 0.3
#: Errors of a scale below so many levels count as of this one: its logarithm changes too fast to say.
_LEAST_SCALE = 0.05


def with_cheap_levels(geometry: Geometry, scene: Scene, curvatures: F64, price: float) -> Geometry:
    """The same geometry with opacities and scales of levels that are worth their bits.

    Args:
        geometry: of a .potr file of version 2 or later.
        scene: what it was made of, in the form of files
            (:func:`potr_cl.stages.fitting.parameters.in_form_of_files`).
        curvatures: (11, N) of the scene (:func:`potr_cl.stages.fitting.curvature.curvatures`).
        price: mean squared error that a bit is worth.
    """
    order, factors = geometry.order, geometry.parameters
    logits = np.clip(scene.opacity_logits[order].astype(np.float64), *RANGE_OF_LOGITS)
    wanted = (logits - LEAST_LOGIT) * factors.sf_opacity
    opacities = _cheapest(wanted, curvatures[10, order] / factors.sf_opacity**2, price, lambda level: level)
    scales = []
    for axis in range(3):
        wanted = np.exp(scene.log_scales[order, axis].astype(np.float64)) * factors.sf_scale
        each = curvatures[3 + axis, order] / np.maximum(wanted, _LEAST_SCALE) ** 2
        scales.append(_cheapest(wanted, each, price, lambda level: np.maximum(level, ZERO_SCALE)))
    # Steps of rotations follow from the scales' levels.
    imaginary, _ = canonical_rotations(scene.quaternions, scene.log_scales, order)
    rotations = VERSIONS[factors.version].quantize_rotations(imaginary, scales, factors.sf_rotation, map)
    return dataclasses.replace(geometry, opacities=opacities, scales=scales, rotations=list(rotations), steps=None)


def _cheapest(wanted: F64, curvatures: F64, price: float, value_of: Callable[[I64], F64 | I64]) -> Integers:
    """(N,) levels >= 0.

    Args:
        wanted: (N,) in levels, not rounded. curvatures: (N,) what a squared error of a level costs.
        price: of a bit.
        value_of: what a level stands for.
    """
    all_nearest = np.maximum(np.floor(wanted + 0.5), 0).astype(np.int64)
    small = np.flatnonzero(all_nearest < _MOST)
    nearest, wanted, curvatures = all_nearest[small], wanted[small], curvatures[small]
    chosen = nearest
    for _ in range(_ROUNDS):
        used = np.bincount(chosen, minlength=_MOST + _SPAN) + _UNUSED
        bits = np.log2(used.sum()) - np.log2(used)
        least = np.full(len(wanted), np.inf)
        better = nearest.copy()
        for step in range(-_SPAN, _SPAN + 1):
            level = np.maximum(nearest + step, 0)
            cost = curvatures * (wanted - value_of(level)) ** 2 + price * bits[level]
            some = cost < least
            least[some], better[some] = cost[some], level[some]
        chosen = better
    all_nearest[small] = chosen
    found: Integers = all_nearest.astype(level_type(float(all_nearest.max(initial=0))))
    return found
