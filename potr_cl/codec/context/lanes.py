"""How splats lie in lanes that are coded side by side, and the prediction of integers along a lane.

A step is the next splat of every lane; it has nothing to do with the steps of a quantiser.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

I64 = NDArray[np.int64]

#: Splats of a lane, unless there are too many for :data:`_MOST_LANES`.
_LANE = 256
_MOST_LANES = 8192
#: Lanes that are split or joined at a time: whole lines of a cache.
_TURNED = 64


@dataclass(frozen=True)
class Lanes:
    """How n splats lie in lanes: splat ``lane · steps + step``; the last lanes may be shorter or empty."""

    splats: int

    @property
    def number(self) -> int:
        return min(-(-self.splats // _LANE), _MOST_LANES)

    @property
    def steps(self) -> int:
        return -(-self.splats // self.number)

    @property
    def counts(self) -> I64:
        """(steps,) lanes that have a splat in each step."""
        return (self.splats - 1 - np.arange(self.steps)) // self.steps + 1

    def split(self, values: NDArray[np.integer]) -> NDArray[np.integer]:
        """(n,) to (steps, lanes), missing ones 0."""
        padded = np.zeros(self.number * self.steps, values.dtype)
        padded[: len(values)] = values
        lanes = padded.reshape(self.number, self.steps)
        laid = np.empty((self.steps, self.number), values.dtype)
        for start in range(0, self.number, _TURNED):
            laid[:, start : start + _TURNED] = lanes[start : start + _TURNED].T
        return laid

    def join(self, laid: NDArray[np.integer]) -> NDArray[np.integer]:
        """(steps, lanes) to (n,)."""
        lanes = np.empty((self.number, self.steps), laid.dtype)
        for start in range(0, self.number, _TURNED):
            # The steps of thousands of lanes lie where they drive each other out of a cache: so first close together.
            lanes[start : start + _TURNED] = np.ascontiguousarray(laid[:, start : start + _TURNED]).T
        return lanes.reshape(-1)[: self.splats]


def to_residuals(values: NDArray[np.integer]) -> NDArray[np.integer]:
    """Predict: (steps, lanes) integers, each less the rounded mean of the four before in its lane."""
    wide: NDArray[Any] = values.astype(np.int32 if values.itemsize < 4 else np.int64)
    before = np.concatenate([np.zeros((4, values.shape[1]), wide.dtype), wide])
    before = (before[:-4] + before[1:-3] + before[2:-2] + before[3:-1] + 2) >> 2
    wide -= before
    return wide


def from_residuals(residuals: I64) -> I64:
    """Undo :func:`to_residuals`: each integer is the residual plus the rounded mean of the four before in its lane."""
    values = np.zeros((len(residuals) + 4, residuals.shape[1]), np.int64)
    # Sums of the last four, and 2 to round.
    total = np.full(residuals.shape[1], 2, np.int64)
    mean = np.empty_like(total)
    for residual, value, leaving in zip(residuals, values[4:], values, strict=False):
        np.right_shift(total, 2, mean)
        np.add(residual, mean, value)
        np.add(total, value, total)
        np.subtract(total, leaving, total)
    return values[4:]
