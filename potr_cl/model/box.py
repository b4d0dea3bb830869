"""An axis-parallel box in the world: :class:`Box`, as a part of a scene is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """All points p with low <= p <= high on every axis, world units.

    Attributes:
        low, high: its corners.
    """

    low: Corner
    high: Corner

    @staticmethod
    def of(numbers: Sequence[float]) -> Box:
        """A box from the six numbers x0 y0 z0 x1 y1 z1, any of which may be infinite.

        Raises:
            UsageError: there are not six, one is no number or NaN, or the corners are exchanged.
        """
        try:
            corners = [float(number) for number in numbers]
        except (TypeError, ValueError):
            raise UsageError("a box is six numbers: x0 y0 z0 x1 y1 z1") from None
        if len(corners) != 6:
            raise UsageError(f"a box is six numbers, x0 y0 z0 x1 y1 z1, not {len(corners)}")
        if any(number != number for number in corners):
            raise UsageError("one of a box's six numbers is NaN: give inf or -inf where the box has no end")
        low, high = (corners[0], corners[1], corners[2]), (corners[3], corners[4], corners[5])
        for axis, least, most in zip("xyz", low, high, strict=True):
            if least > most:
                raise UsageError(f"the box ends at {axis} = {most:g}, before it begins at {least:g}")
        return Box(low, high)

    def holds(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) which of (N, 3) points lie in it."""
        inside = np.ones(len(points), bool)
        with np.errstate(over="ignore"):  # beyond single precision a corner is at infinity
            for axis in range(3):
                inside &= (points[:, axis] >= self.low[axis]) & (points[:, axis] <= self.high[axis])
        return inside

    def meets(self, other: Box) -> bool:
        """Whether a point lies in both."""
        return all(a <= d and c <= b for a, b, c, d in zip(self.low, self.high, other.low, other.high, strict=True))

    def covers(self, other: Box) -> bool:
        """Whether all of the other lies in it."""
        return all(a <= c and d <= b for a, b, c, d in zip(self.low, self.high, other.low, other.high, strict=True))

    def __str__(self) -> str:
        return " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(self.low, self.high, strict=True))
