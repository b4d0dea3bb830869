"""Which tiles a measurement sweeps again: what may be traded for speed, and bookkeeping without a device.

A tile's staleness is the importance removed from it since its last sweep, as a part of its area; infinite before the
first sweep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


Indices = NDArray[np.int64]


class TileSchedule:
    """Chooses the tiles of a measurement by staleness, and in turns.

    Args:
        options: tolerance and turns.
        views: (number among the cameras, tiles) of the views whose tiles are numbered through, in their order.
    """

    def __init__(self, options: SweepOptions, views: Sequence[tuple[int, int]]) -> None:
        self._options = options
        self._numbers = np.array([number for number, _ in views], np.int64)
        self._tiles = np.array([tiles for _, tiles in views], np.int64)

    def choose(self, measurement: int, stale: NDArray[np.float32]) -> Indices:
        """The tiles that a measurement sweeps, ascending.

        Args:
            measurement: its number, from 0. The first takes no turns.
            stale: (tiles,) each tile's staleness.
        """
        options = self._options
        wanted = stale > options.tolerance
        if options.turns > 1 and measurement > 0:
            wanted &= np.repeat((measurement + self._numbers) % options.turns == 0, self._tiles)
        return np.flatnonzero(wanted)

    def changed(self, stale: NDArray[np.float32]) -> Indices:
        """The tiles that anything was removed from since their last sweep, ascending."""
        return np.flatnonzero(stale > 0)

    def note_swept(self, stale: NDArray[np.float32], tiles: Indices) -> None:
        """Write into ``stale`` that tiles were swept. With a negative tolerance they are stale again at once."""
        stale[tiles] = 0 if self._options.tolerance >= 0 else np.inf


def by_set(tiles: Indices, firsts: Sequence[int]) -> tuple[NDArray[np.uint32], list[int]]:
    """Tiles that are numbered through all sets as the list that sets are swept from.

    Args:
        tiles: their numbers, ascending.
        firsts: each set's first tile, ascending, and the end of the last one.

    Returns:
        (firsts[-1],) uint32, from each set's first tile on the numbers of its chosen tiles within it; and how many
        these are, set by set.
    """
    starts = np.searchsorted(tiles, firsts)
    counts = np.diff(starts)
    listed = np.zeros(firsts[-1], np.uint32)
    own = np.repeat(np.asarray(firsts[:-1], np.int64), counts)
    listed[own + np.arange(len(tiles)) - np.repeat(starts[:-1], counts)] = tiles - own
    return listed, counts.tolist()
