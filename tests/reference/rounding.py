"""Coefficients rounded in turn, in float64 and by definition: :func:`rounded_in_turn`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.outputs.output import ColourGrid

Array = NDArray[np.float64]


def rounded_in_turn(
    block: Array,
    x: Array,
    free: NDArray[np.bool_],
    step: float,
    to_zero: float,
    damping: float = 1e-2,
    floor: float = 1e-3,
) -> tuple[Array, float]:
    """AC coefficients of one channel of one splat as multiples of a step, the last one first.

    Before each, those that are free yet go to where y - x is shortest by the block, with what is rounded held.

    Args:
        block: (M, M), what squared errors of the channel's coefficients cost together.
        x: (M,) the coefficients. free: (M,) those that may change.
        step: of the AC coefficients.
        to_zero: what it saves to have 0 instead of one step.
        damping, floor: added to the diagonal, as a part of its mean, and besides.

    Returns:
        The coefficients, the constant one not rounded; and how near, relatively, a decision was.
    """
    count = len(x)
    block = block + (damping * np.trace(block) / count + floor) * np.eye(count)
    y, left, margin = x.copy(), free.copy(), np.inf
    for m in range(count - 1, 0, -1):
        if not left[m]:
            continue
        index, held = np.flatnonzero(left), np.flatnonzero(free & ~left)
        y[index] = x[index] - np.linalg.solve(
            block[np.ix_(index, index)], block[np.ix_(index, held)] @ (y[held] - x[held])
        )
        others = index[index < m]
        cost = block[m, m] - block[m, others] @ np.linalg.solve(block[np.ix_(others, others)], block[others, m])
        level = np.floor(y[m] / step + 0.5)
        margin = min(margin, abs(y[m] / step + 0.5 - np.round(y[m] / step + 0.5)))
        if abs(level) == 1:
            more = cost * (y[m] ** 2 - (y[m] - step * level) ** 2)
            margin = min(margin, abs(more / to_zero - 1) if to_zero else np.inf)
            level = 0.0 if more < to_zero else level
        y[m] = step * level
        left[m] = False
    index, held = np.flatnonzero(left), np.flatnonzero(free & ~left)
    y[index] = x[index] - np.linalg.solve(block[np.ix_(index, index)], block[np.ix_(index, held)] @ (y[held] - x[held]))
    return y, margin


def grid_of(count: int, step: float = 0.1) -> ColourGrid:
    """Steps that differ by splat, in an order that is not the scene's."""
    rng = np.random.default_rng(0)
    steps = (step * 2.0 ** rng.uniform(-1, 1, (2, count))).astype(np.float32)
    return ColourGrid(steps[0], steps[1], rng.permutation(count))
