"""Which tiles a measurement sweeps again: bookkeeping without a device.

A tile's staleness is the importance removed from it since its last sweep, as a part of its area; infinite before the
first sweep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.stages.pruning.sweep_options import SweepOptions

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


@dataclass(frozen=True)
class TileLists:
    """Chosen tiles, set by set.

    Attributes:
        tiles: numbers of the tiles within their set.
        starts, counts: where each set's part of ``tiles`` begins, and its length.
    """

    tiles: Indices
    starts: list[int]
    counts: list[int]


def by_set(tiles: Indices, first_tiles: Sequence[int]) -> TileLists:
    """Tiles that are numbered through all sets as lists of the sets.

    Args:
        tiles: their numbers, ascending.
        first_tiles: of each set, ascending.
    """
    starts = np.append(np.searchsorted(tiles, first_tiles), len(tiles)).astype(np.int64)
    counts = np.diff(starts)
    within = tiles - np.repeat(np.asarray(first_tiles, np.int64), counts)
    return TileLists(within, starts[:-1].tolist(), counts.tolist())
