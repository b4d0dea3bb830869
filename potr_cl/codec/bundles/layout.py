"""Where the items of streams are coded: bundles of splats, and in each bundle lanes that are coded side by side.

A *bundle* is a run of splats that needs no other for its decoding, so that bundles are what threads share out. A
stream has some *items* in each bundle: one a splat, or one for each thing that only some splats have. The items of a
bundle are shared out evenly over its lanes, in their order, so that no lane waits for another.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

I64 = NDArray[np.int64]

#: Most splats of a lane, and most lanes of a bundle.
LANE, LANES = 256, 32
#: Splats of every bundle but the last.
BUNDLE = LANE * LANES


@dataclass(frozen=True)
class Bundles:
    """The bundles of a run of splats that begins with a bundle.

    Attributes:
        splats: n, at least 1.
    """

    splats: int

    @property
    def number(self) -> int:
        return -(-self.splats // BUNDLE)

    @cached_property
    def lanes(self) -> I64:
        """(bundles,) lanes of each."""
        return -(-np.minimum(self.splats - BUNDLE * np.arange(self.number), BUNDLE) // LANE)

    @cached_property
    def dense(self) -> Layout:
        """Of the streams that have an item for each splat."""
        return self.items(np.arange(self.splats))

    def items(self, splats: NDArray[np.integer]) -> Layout:
        """Of a stream with an item for each of some splats, which are named in order, and may be named repeatedly."""
        return Layout(np.bincount(splats // BUNDLE, minlength=self.number), self.lanes)


@dataclass(frozen=True)
class Layout:
    """Where a stream's items are in rows, one for each step, with 32 columns for each bundle, one for each lane.

    Attributes:
        counts: (bundles,) items of each.
        lanes: (bundles,) lanes of each.
    """

    counts: I64
    lanes: I64

    @cached_property
    def steps(self) -> I64:
        """(bundles,) items of a lane, but for the last ones."""
        return -(-self.counts // self.lanes)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.steps.max(initial=0)), LANES * len(self.counts)

    @cached_property
    def places(self) -> I64:
        """(items,) where each item is in the flattened rows."""
        places, end = np.empty(int(self.counts.sum()), np.int64), 0
        rows = np.arange(self.shape[0]) * self.shape[1]
        for bundle, (count, lanes, steps) in enumerate(zip(self.counts, self.lanes, self.steps, strict=True)):
            columns = LANES * bundle + np.arange(lanes)
            places[end : end + count] = (columns[:, None] + rows[:steps]).ravel()[:count]
            end += count
        return places

    @cached_property
    def idle(self) -> NDArray[np.bool_]:
        """(rows, columns) where no item is."""
        idle = np.ones(self.shape, bool)
        idle.ravel()[self.places] = False
        return idle

    def laid(self, values: NDArray[Any], dtype: type[np.generic] | None = None) -> NDArray[Any]:
        """(items,) to (rows, columns), of another type if one is given; 0 where there is no item."""
        rows = np.zeros(self.shape, dtype or values.dtype)
        rows.ravel()[self.places] = values
        return rows

    def taken(self, rows: NDArray[Any]) -> NDArray[Any]:
        """(rows, columns) to (items,)."""
        return rows.ravel()[self.places]
