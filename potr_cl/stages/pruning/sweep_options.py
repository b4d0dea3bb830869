"""Speed/accuracy trade-offs of a removal sweep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from potr_cl.errors import UsageError

#: The least threshold: smaller transmittances lose digits in float32, and the sweep divides by them.
_LEAST_THRESHOLD = 1e-30


@dataclass(frozen=True)
class SweepOptions:
    """Speed/accuracy trade-offs of a removal sweep.

    Attributes:
        tolerance: a tile is swept again once the importance removed from it, as a part of its area, exceeds this.
            0: whenever anything was removed from it; negative: always.
        turns: with n, a view is swept only in every n-th measurement after the first. Views that do not fit the memory
            budget are swept in each measurement.
        memory: bytes of device memory that the views may take; None: :func:`potr_cl.views.budget.default_memory`.
        transmittance_threshold: a pixel ends before its transmittance falls below this; None: where the rasterizer's
            rules end it. When a removal lets a pixel go on one splat longer, its colour jumps by up to the hundredfold
            of this.

    Raises:
        UsageError: a value is out of range.
    """

    tolerance: float = 0.01
    turns: int = 1
    memory: int | None = None
    transmittance_threshold: float | None = 1e-8

    def __post_init__(self) -> None:
        if not np.isfinite(self.tolerance):
            raise UsageError(f"the tile tolerance is {self.tolerance:g}, it must be a number")
        if self.turns < 1:
            raise UsageError(f"views cannot be swept every {self.turns} measurements: at least 1 is needed")
        if self.memory is not None and self.memory < 0:
            raise UsageError(f"the memory budget must not be negative ({self.memory} bytes)")
        if self.transmittance_threshold is not None and not _LEAST_THRESHOLD <= self.transmittance_threshold < 1:
            raise UsageError(
                f"a pixel cannot end at a transmittance of {self.transmittance_threshold:g}: at least "
                f"{_LEAST_THRESHOLD:g}, below 1"
            )

    @property
    def only_by_tolerance(self) -> bool:
        """Whether a tile's staleness alone decides when it is swept again: no turns."""
        return self.turns == 1
