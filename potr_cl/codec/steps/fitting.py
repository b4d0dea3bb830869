"""Finds the steps of colours that fit a scene: :func:`fit_steps`.

An error of variance s² in a splat's colour adds h s² to the squared error of the pictures, with the splat's *effect* h;
a step s costs -log2 s bits. So with s² = 1 / w, w the weight that the decoder will compute, the best weights of a
family are those with the least sum of h / w + ln w: the likelihood of a gamma distribution whose mean is w. The
logarithm of w is linear in the rule's numbers, which makes the sum convex; Newton's method finds the minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.steps.rule import (
    CLASS_SHIFT,
    GROUP_UNIT,
    KNOTS,
    OCTAVE,
    SHIFT,
    ColourSteps,
    Levels,
    logarithms,
    places,
)

F64 = NDArray[np.float64]

#: A rule costs some hundred bytes: fewer splats do not save them.
FEWEST = 256
#: Of the mean effect, added to all: what no training view shows well may be seen in another.
_FLOOR = 0.02
#: Exponents of the weight, in sixteenths: a root for DC; less for AC coefficients, most of which are 0 anyway.
_POWERS = (8, 6)
#: Splats of a group, as a power of two.
_GROUP_BITS = 4
#: Logits of opacity between the first and the last place, and of the first one above the least.
_LOGITS, _FIRST_LOGIT = 10.0, 2.0
#: Splats that a rule is fitted to.
_FITTED = 1 << 13
_MOST_STEPS = 30
#: The most that a group adds, in its units.
_MOST_OF_GROUP = 12


def fit_steps(
    scales: Sequence[Levels], opacities: Levels, sf_opacity: float, effects: NDArray[np.floating]
) -> ColourSteps | None:
    """The steps that fit a scene's splats.

    The mean squared error that the steps add is that of steps that are the same for all.

    Args:
        scales: (N,) levels of each axis, in the order of the file.
        opacities: (N,) levels.
        sf_opacity: scale factor of the opacities' logits.
        effects: (N,) >= 0, of an error of a splat's colour on the pictures, in any unit.

    Returns:
        None where they would not pay, or nothing is known of the effects.
    """
    return fit_steps_of_blocks([(scales, opacities, effects)], sf_opacity)[0]


def fit_steps_of_blocks(
    blocks: Sequence[tuple[Sequence[Levels], Levels, NDArray[np.floating]]], sf_opacity: float
) -> list[ColourSteps | None]:
    """The same for a scene in blocks, each with a rule of its own; equal effects have equal steps in all of them.

    The mean squared error that the steps of all blocks add is that of steps that are the same for all.

    Args:
        blocks: scales, opacities and effects of each.
        sf_opacity: scale factor of the opacities' logits.

    Returns:
        As :func:`fit_steps`, for each block.
    """
    n = sum(len(effects) for _, _, effects in blocks)
    mean = sum(float(np.add.reduce(effects, dtype=np.float64)) for _, _, effects in blocks) / max(n, 1)
    if n < FEWEST or not 0 < mean < np.inf:
        return [None] * len(blocks)
    fitted = [
        _fitted(scales, opacities, sf_opacity, np.asarray(effects, np.float64) / mean)
        for scales, opacities, effects in blocks
    ]
    of_power = {power: _offset([(weights, h) for _, weights, h in fitted], power) for power in _POWERS}
    offsets = (of_power[_POWERS[0]], of_power[_POWERS[1]])
    return [replace(steps, offsets=offsets) for steps, _, _ in fitted]


def _fitted(
    scales: Sequence[Levels], opacities: Levels, sf_opacity: float, h: F64
) -> tuple[ColourSteps, NDArray[np.int64], F64]:
    """The rule of some splats but for its offsets, their weights, and their effects over the mean effect."""
    n = len(h)
    spaces = KNOTS - 1
    knot_shift = max(int(np.ceil(np.log2(max(_LOGITS * sf_opacity / spaces, 1)))), 0)
    first_knot = min(int(_FIRST_LOGIT * sf_opacity) >> knot_shift, 255)
    steps = ColourSteps(
        _GROUP_BITS,
        knot_shift,
        first_knot,
        _POWERS,
        (0, 0),
        (0, 0, 0),
        (0,) * KNOTS,
        np.zeros(-(-n >> _GROUP_BITS), np.int8),
    )
    some = slice(None, None, -(-n // _FITTED))
    raised = (h + _FLOOR) / (1 + _FLOOR)
    terms = _terms([axis[some] for axis in scales], opacities[some], steps)
    found = np.rint(_minimum(terms, raised[some]) * (OCTAVE / np.log(2)) * _UNITS)
    found = np.clip(found, -32767, 32767).astype(int).tolist()
    steps = replace(steps, scales=tuple(found[:3]), opacities=tuple(found[3:]))
    weights = steps.weights(scales, opacities)
    steps = replace(steps, groups=_groups(raised * np.exp2(-weights / OCTAVE), _GROUP_BITS))
    weights += GROUP_UNIT * np.repeat(steps.groups.astype(np.int64), 1 << _GROUP_BITS)[:n]
    return steps, weights, h


#: Of the rule's numbers: logarithms' factors are fractions.
_UNITS = np.array([1 << SHIFT] * 3 + [1] * KNOTS)


def _terms(scales: Sequence[Levels], opacities: Levels, steps: ColourSteps) -> F64:
    """(n, 3 + KNOTS) by which the rule's numbers are multiplied."""
    logs = np.sort(np.stack([logarithms(axis) for axis in scales], axis=1), axis=1)[:, ::-1]
    place, part = places(opacities, steps.first_knot, steps.knot_shift)
    share = part / (1 << steps.knot_shift)
    terms = np.zeros((len(logs), 3 + KNOTS))
    terms[:, :3] = logs
    rows = np.arange(len(logs))
    terms[rows, 3 + place] = 1 - share
    terms[rows, 4 + place] = share
    return terms


def _minimum(terms: F64, effects: F64) -> F64:
    """The factors x with the least sum of effects · exp(-terms · x) + terms · x, and of a bit for smoothness.

    Sums are made by NumPy's own loops, whose order does not depend on the number of threads.
    """
    n, count = terms.shape
    bend = np.zeros((KNOTS - 2, count))
    for k in range(KNOTS - 2):
        bend[k, 3 + k : 6 + k] = (1, -2, 1)
    hold = n * (1e-3 * np.einsum("ki,kj->ij", bend, bend) + 1e-6 * np.eye(count))

    def cost(x: F64) -> tuple[float, F64]:
        logarithm = np.einsum("ni,i->n", terms, x)
        ratio = effects * np.exp(np.clip(-logarithm, -80, 80))
        return float(np.add.reduce(ratio + logarithm) + x @ hold @ x / 2), ratio

    gram = np.einsum("ni,nj->ij", terms, terms) + hold
    x = np.linalg.solve(gram, np.einsum("ni,n->i", terms, np.log(effects)))
    value, ratio = cost(x)
    for _ in range(_MOST_STEPS):
        slope = np.einsum("ni,n->i", terms, 1 - ratio) + hold @ x
        step = np.linalg.solve(np.einsum("ni,nj->ij", terms * ratio[:, None], terms) + hold, slope)
        part = 1.0
        while (tried := cost(x - part * step))[0] > value and part > 1e-3:
            part /= 2
        gained = value - tried[0]
        if gained <= 0:
            break
        x, (value, ratio) = x - part * step, tried
        if gained < 1e-6 * n:
            break
    return x


def _groups(left: F64, bits: int) -> NDArray[np.int8]:
    """What each group adds to its splats' weights, from the effects over the weights so far."""
    size = 1 << bits
    starts = np.arange(0, len(left), size)
    means = np.add.reduceat(left, starts) / np.minimum(size, len(left) - starts)
    octaves = np.log2(means + 0.02)
    return np.clip(np.rint(octaves * (OCTAVE / GROUP_UNIT)), -_MOST_OF_GROUP, _MOST_OF_GROUP).astype(np.int8)


def _offset(blocks: Sequence[tuple[NDArray[np.int64], F64]], power: int) -> int:
    """What is added to weights times their power, for the error of equal steps: half a class, to round, and more."""
    error = total = 0.0
    for weights, effects in blocks:
        classes = weights * power / (1 << CLASS_SHIFT)
        error += float(np.add.reduce(effects * np.exp2(-classes / 2)))
        total += float(np.add.reduce(effects))
    more = 2 * np.log2(error / total)
    return int(np.clip(round((more + 0.5) * (1 << CLASS_SHIFT)), -32768, 32767))
