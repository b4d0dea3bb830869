"""The prediction of DC where steps differ: :func:`to_residuals` and back.

What is predicted is a colour, not a level: the mean colour of the four splats before, in the next splat's steps. All in
integers of 64 bits that wrap round, so that every decoder finds the same. docs/format.md, "Prediction".
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native import quantising
from potr_cl.codec.steps.rule import CLASSES
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

I64 = NDArray[np.int64]
I8 = NDArray[np.int8]

#: Splats before that are looked at.
BEFORE = 4
#: Splats after which prediction begins anew, so that there are several to work on at a time.
RUN = 256
#: Bits behind the point of a step, and of its inverse.
_POINT = 16
#: Of a mean of four, in the next splat's steps.
_MEAN_SHIFT = 2 * _POINT + 2
_HALF = 1 << (_MEAN_SHIFT - 1)


@lru_cache(maxsize=1)
def tables() -> tuple[I64, I64]:
    """(2 CLASSES,) steps of each class, 2^(-class / 4), and their inverses, with 16 bits behind the point.

    Those within an octave are 65536, 77936, 92682 and 110218; the others are these, shifted.
    """
    octave = (65536, 77936, 92682, 110218)

    def shifted(quarter: int) -> int:
        bits = quarter >> 2
        return octave[quarter & 3] << bits if bits >= 0 else octave[quarter & 3] >> -bits

    quarters = range(-CLASSES, CLASSES)
    steps = np.array([shifted(-k) for k in quarters], np.int64)
    inverses = np.array([shifted(k) for k in quarters], np.int64)
    return steps, inverses


@definition
def to_residuals(levels: I64, classes: I8) -> I64:
    """(channels, n) levels, each less its prediction; ``classes`` (n,) are those of DC."""
    steps, inverses = (table[classes.astype(np.intp) + CLASSES] for table in tables())
    values = levels * steps
    total = np.zeros_like(values)
    for back in range(1, BEFORE + 1):
        total[:, back:] += values[:, :-back]
        # What lies before the beginning of a run does not count.
        for k in range(back):
            at = np.arange(RUN + k, levels.shape[1], RUN)
            total[:, at] -= values[:, at - back]
    return levels - ((total * inverses + _HALF) >> _MEAN_SHIFT)


def _to_residuals_by_c(c: CFunctions, levels: I64, classes: I8) -> I64:
    return quantising.predicted(c, np.ascontiguousarray(levels), np.ascontiguousarray(classes), RUN, *tables())


def from_residuals(residuals: I64, classes: I8) -> I64:
    """Undo :func:`to_residuals`."""
    steps, inverses = tables()
    channels, n = residuals.shape
    runs = -(-n // RUN)
    index = classes.astype(np.intp) + CLASSES
    laid = np.zeros((RUN, channels, runs), np.int64)
    by_class = np.zeros((2, RUN, 1, runs), np.int64)
    for c, row in enumerate(residuals):
        laid[:, c] = _turned(row, runs)
    for k, table in enumerate((steps, inverses)):
        by_class[k, :, 0] = _turned(table[index], runs)
    last = np.zeros((BEFORE, channels, runs), np.int64)
    total, mean = np.zeros((2, channels, runs), np.int64)
    half, shift = np.array(_HALF), np.array(_MEAN_SHIFT)  # as arrays they are taken in half the time
    for t, (level, step, inverse) in enumerate(zip(laid, *by_class, strict=True)):
        if t == n:
            break
        np.multiply(total, inverse, mean)
        np.add(mean, half, mean)
        np.right_shift(mean, shift, mean)
        np.add(level, mean, level)
        value = last[t % BEFORE]
        np.subtract(total, value, total)
        np.multiply(level, step, value)
        np.add(total, value, total)
    return np.stack([np.ascontiguousarray(laid[:, c].T).reshape(-1)[:n] for c in range(channels)])


def _turned(row: I64, runs: int) -> I64:
    """(RUN, runs) of (n,), missing ones 0."""
    padded = np.zeros(runs * RUN, np.int64)
    padded[: len(row)] = row
    return padded.reshape(runs, RUN).T
