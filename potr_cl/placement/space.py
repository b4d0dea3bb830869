"""Where a scene has matter and where it is free: a grid of cells, through which rays run (:class:`Space`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.sampling import F64, low_discrepancy, opacity_weighted, turned
from potr_cl.model.scene import Scene

F32 = NDArray[np.float32]

#: The renderer's near plane in world units, with room to spare: nothing nearer than this is ever seen.
NEAR = 0.25
#: Splats that are looked at at most, evenly taken; and points on them besides one for each, as far as this from their
#: centres, in standard deviations.
_TAKEN, _POINTS, _WIDE = 400_000, 400_000, 1.5
#: A splat's opacity from which it counts as matter.
OPAQUE = 0.1
#: Optical depth from which a cell is taken for matter: haze and lone floaters are free.
_BLOCKING = 0.5
#: Cells of the grid at most, and points for each occupied one at least: with fewer, surfaces would have holes.
_CELLS, _POINTS_A_CELL = 4_000_000, 5
#: The part of the splats on either side of each axis that lie outside of the grid, floaters and backdrops; and how far
#: it reaches at most, in their median distance from their middle.
_OUTSIDE, _FARTHEST = 0.005, 30
#: Cells along a side of the blocks in which splats are taken to be of like size.
_BLOCK = 6
#: Free cells around the grid; and the farthest that is known of a free cell, in cells.
_MARGIN, _FAR = 2, 16
#: A ray advances by this part of a cell at least.
_LEAST = 0.6


@dataclass(frozen=True)
class Space:
    """A grid of cells with matter, and free ones.

    Attributes:
        origin: (3,) its lowest corner, world units.
        cell: edge of a cell, world units.
        shape: number of cells along each axis.
        distance: (cells,) uint8: how many cells the nearest matter is away, along the axis where it is farthest; 0: the
            cell has matter.
        rows: (P,) numbers of the splats that ``points`` lie on, ascending.
        points: (P, 3) on the scene's surfaces: one on each splat that was looked at, more on large ones.
        sizes: (blocks,) the larger standard deviation of splats in blocks of cells, the geometric mean, world units.
    """

    origin: F64
    cell: float
    shape: tuple[int, int, int]
    distance: NDArray[np.uint8]
    rows: NDArray[np.int64]
    points: F64
    sizes: F64

    @cached_property
    def firsts(self) -> NDArray[np.int64]:
        """The number of a point on each splat that was looked at."""
        return np.flatnonzero(np.diff(self.rows, prepend=-1))

    @staticmethod
    def of(scene: Scene) -> Space:
        """The space of a scene: clean, at least one splat."""
        every = max(-(-len(scene) // _TAKEN), 1)
        taken = np.arange(0, len(scene), every)
        if (solid := scene.opacities[taken] > OPAQUE).any():
            taken = taken[solid]
        scales = np.exp(np.clip(scene.log_scales[taken].astype(np.float64), -60, 60))
        means = scene.means[taken].astype(np.float64)
        middle = np.median(means, axis=0)
        usual = float(np.median(np.linalg.norm(means - middle, axis=1)))
        low, high = np.quantile(means, [_OUTSIDE, 1 - _OUTSIDE], axis=0)
        low, high = np.maximum(low, middle - _FARTHEST * usual), np.minimum(high, middle + _FARTHEST * usual)
        # A backdrop, whose splats are as wide as all that stands before it, is no matter.
        widest = scales.max(axis=1)
        matter = widest <= max(usual, 3 * float(np.median(widest)))
        areas = every * opacity_weighted(scales, scene.opacities[taken].astype(np.float64)) * matter
        # One point for each splat, and more the larger it is.
        more = np.minimum(areas, 1000 * areas.mean())
        copies = 1 + (more * (_POINTS / max(float(more.sum()), 1e-300))).astype(np.int64)
        rows = np.repeat(np.arange(len(taken)), copies)
        points = _WIDE * (2 * low_discrepancy(len(rows), 3) - 1) * scales[rows]
        points = turned(points, scene.quaternions[taken[rows]].astype(np.float64))
        points += means[rows]
        weights = (areas / copies)[rows]

        most = max(float((high - low).max()), float(np.median(widest)), 1e-6 * float(np.abs(middle).max()), 1e-12)
        extent = np.maximum(high - low, 1e-3 * most)
        low, high = low - 0.02 * extent, high + 0.02 * extent
        inside = np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))
        offsets, weights = points[inside] - low, weights[inside]
        cell = max(float(np.prod((high - low) / _CELLS ** (1 / 3)) ** (1 / 3)), float((high - low).max()) / 1000)
        while True:
            x, y, z = (int(n) + 1 + 2 * _MARGIN for n in (high - low) / cell)
            shape = (x, y, z)
            keys = _keys((offsets / cell).astype(np.int64) + _MARGIN, shape)
            fine = weights <= cell**2
            depth = np.bincount(keys, np.where(weights < 4 * cell**2, weights, 0), math.prod(shape)) / cell**2
            occupied = depth >= _BLOCKING
            # Else surfaces have holes: a cell has too few points, or points stand for more than a cell.
            dense = weights[fine].sum() >= 0.5 * weights.sum()
            if dense and np.count_nonzero(occupied) * _POINTS_A_CELL <= len(rows):
                break
            cell *= 1.25
        distance = _distances(occupied.reshape(shape)).reshape(-1)
        space = Space(low - _MARGIN * cell, cell, shape, distance, taken[rows], points, np.empty(0))
        blocks = space._blocks(points[firsts := space.firsts])
        logs = np.log(scales[rows[firsts]].max(axis=1))
        counts = np.bincount(blocks, minlength=math.prod(space._block_shape) + 1)
        means = np.bincount(blocks, logs, len(counts)) / np.maximum(counts, 1)
        return replace(space, sizes=np.exp(np.where(counts > 0, means, np.median(logs))))

    @property
    def _block_shape(self) -> tuple[int, int, int]:
        x, y, z = (-(-cells // _BLOCK) for cells in self.shape)
        return x, y, z

    def _blocks(self, points: F64) -> NDArray[np.int64]:
        """The number of the block that each point lies in; beyond them: outside of the grid."""
        cells = self.cell_of(points)
        blocks = np.stack(np.unravel_index(np.maximum(cells, 0), self.shape), axis=1) // _BLOCK
        return np.where(cells >= 0, _keys(blocks, self._block_shape), math.prod(self._block_shape))

    def sizes_near(self, points: F64) -> F64:
        """(n,) how large splats near (n, 3) points are, world units: the geometric mean."""
        return self.sizes[self._blocks(points)]

    def free(self, points: F64) -> NDArray[np.int64]:
        """(n,) how many cells the nearest matter is away from each of (n, 3) points; outside of the grid, the most."""
        cells = self.cell_of(points)
        return np.where(cells >= 0, self.distance[cells], _FAR).astype(np.int64)

    def cell_of(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        """(n,) the number of the cell that each of (n, 3) points lies in; -1: outside of the grid."""
        cells = np.floor((points - self.origin) / self.cell)
        inside = np.all((cells >= 0) & (cells < self.shape), axis=1)
        return np.where(inside, _keys(np.where(inside[:, None], cells, 0).astype(np.int64), self.shape), -1)

    def middles(self, cells: NDArray[np.int64]) -> F64:
        """(n, 3) the middles of cells, (n,), world units."""
        return self.origin + (np.stack(np.unravel_index(cells, self.shape), axis=1) + 0.5) * self.cell

    def near_free(self, clear: int, most: int) -> NDArray[np.bool_]:
        """(cells,) whether a cell is at most ``most`` cells away from one that is ``clear`` cells away from matter."""
        free = np.greater_equal(self.distance, clear).reshape(self.shape)
        near: NDArray[np.bool_] = np.less_equal(_distances(free, most + 1).reshape(-1), most)
        return near

    def reach(self, starts: F64, directions: F64, lengths: F64) -> F64:
        """How far rays run before they meet matter.

        Args:
            starts: (n, 3) where they begin.
            directions: (n, 3) unit vectors.
            lengths: (n,) how far they run at most.

        Returns:
            (n,) the way until the first cell with matter; the whole length where there is none.
        """
        # Far from the grid single precision is too coarse.
        start, skipped = self._nearer(starts, directions)
        along = directions.astype(np.float32)
        whole = (lengths / self.cell - skipped).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            over = 1 / along
            near, far = -start * over, (np.array(self.shape, np.float32) - start) * over
            enter = np.nan_to_num(np.minimum(near, far), nan=-np.inf).max(axis=1)
            leave = np.nan_to_num(np.maximum(near, far), nan=np.inf).min(axis=1)
        enter = np.maximum(enter, 0) + np.float32(1e-3)
        end = np.minimum(whole, leave)
        way = np.where(enter < end, enter, whole)
        left = np.flatnonzero(enter < end)
        last = np.array(self.shape, np.int32) - 1
        stride = np.array([self.shape[1] * self.shape[2], self.shape[2], 1], np.int32)
        while len(left):
            cells = (start[left] + along[left] * way[left, None]).astype(np.int32)
            np.clip(cells, 0, last, out=cells)
            away = self.distance[cells @ stride].astype(np.float32)
            goes_on = away > 0
            left, away = left[goes_on], away[goes_on]
            way[left] += np.maximum(away - 1, np.float32(_LEAST))
            done = way[left] >= end[left]
            way[left[done]] = whole[left[done]]
            left = left[~done]
        return (np.minimum(way, whole) + skipped) * self.cell

    def _nearer(self, starts: F64, directions: F64) -> tuple[F32, F64]:
        """Where rays begin, in cells, (n, 3), those from far away nearer to the grid; and by how much nearer, (n,)."""
        start = (starts - self.origin) / self.cell
        reach = float(np.linalg.norm(self.shape))
        away = np.linalg.norm(start - np.array(self.shape) / 2, axis=1)
        skipped = np.maximum(away - 2 * reach, 0)
        return (start + skipped[:, None] * directions).astype(np.float32), skipped

    def in_cells(self, points: F64, besides: F64) -> F32:
        """(n, 4) points, (n, 3), in cells from the grid's lowest corner, and a fourth number, (n,)."""
        return np.column_stack([(points - self.origin) / self.cell, besides]).astype(np.float32)


def _keys(cells: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
    keys: NDArray[np.int64] = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    return keys


def _distances(occupied: NDArray[np.bool_], most: int = _FAR) -> NDArray[np.uint8]:
    """Chessboard distances to the nearest True, at most ``most``: it grows by a cell along each axis in turn."""
    found = np.where(occupied, 0, most).astype(np.uint8)
    near = occupied.copy()
    for away in range(1, most):
        for axis in range(3):
            ahead = np.moveaxis(near, axis, 0)
            grown = ahead.copy()
            grown[1:] |= ahead[:-1]
            grown[:-1] |= ahead[1:]
            near = np.moveaxis(grown, 0, axis)
        new = near & (found == most)
        if not new.any():
            break
        found[new] = away
    return found
