"""Few vectors that stand for many, :func:`cluster`: weighted k-means on a device.

Comparing every point with every centre takes N K D operations a step: for a million splats and a palette of 65536 sets
of SH coefficients that is a minute on two cores, ten times over. So there are two levels. Some hundred coarse cells are
found first. Each centre lives in the cell that is nearest to it, and a point is compared with those centres alone that
live in the cells next to its own (:data:`_NEIGHBOURS`). docs/benchmarks/outputs.md tells what that costs.

All choices are made in a fixed order: a device gives the same bits on every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.clustering.launch import launcher_for
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner

_U32 = NDArray[np.uint32]
_F64 = NDArray[np.float64]

#: Cells whose centres a point is compared with: its own and those next to it.
_NEIGHBOURS = 8
#: Fewer centres than this are one cell.
_FEW = 512
#: Steps of Lloyd's algorithm: for the cells, and by default for the centres.
_CELL_STEPS, STEPS = 6, 8
#: Points that centres are found from at most, and that cells are: each stands for its neighbours in the scene's order.
_MOST, _MOST_FOR_CELLS = 1 << 20, 1 << 16
#: Seeds are as dense as this power of the points' weights: what is best for vectors of some ten dimensions that matter.
_SEED_POWER = 0.8
#: Floats in a row are a multiple of this.
_QUARTER = 4
_NO_POINT = np.uint32(0xFFFFFFFF)


@dataclass(frozen=True)
class Clusters:
    """Centres, and the one of each point.

    Attributes:
        centres: (K, D) float32.
        labels: (N,) uint32, a number of a centre for each point.
    """

    centres: FloatArray
    labels: _U32


def cluster(
    device: Device,
    points: FloatArray,
    weights: FloatArray,
    entries: int,
    steps: int = STEPS,
    progress: Callable[[float], None] = lambda done: None,
) -> Clusters:
    """Find centres from which the points are little away, by the weighted mean of their squared distances.

    Args:
        device: to compute on.
        points: (N, D) float32, finite; neighbours are best alike, as many seeds are taken in their order.
        weights: (N,) float32, 0 or more.
        entries: K, the most centres there may be, 1 or more.
        steps: of Lloyd's algorithm.
        progress: called with the part of the work that is done.

    Raises:
        DeviceError: the device failed, or has too little memory.
    """
    progress(0.0)
    sample = _spread(len(points), _MOST)
    taken = points if sample is None else points[sample]
    mass = (weights if sample is None else weights[sample]).astype(np.float64)
    mass = np.maximum(mass, mass.mean() * 1e-6 or 1.0)
    # A power of two changes no bit of the sums but keeps them in range.
    mass = np.ldexp(mass, -math.frexp(float(mass.max()))[1])
    with _Points(device, taken, mass) as at:
        finder = _Finder(at, min(entries, len(taken)), mass)
        for step in range(steps):
            finder.improve(refill=step < steps - 1)
            progress((step + 1) / (steps + 1))
        labels = finder.labels()  # sorts the centres
        cells, centres = finder.cells, finder.centres
    if sample is not None:
        labels = np.empty(len(points), np.uint32)
        for start in range(0, len(points), _MOST):
            some = slice(start, start + _MOST)
            with _Points(device, points[some], np.ones(len(points[some]))) as at:
                labels[some] = _nearest_of(at, cells, centres)
    progress(1.0)
    return Clusters(centres, labels)


class _Finder:
    """Centres of some points, step by step.

    Attributes:
        cells: (C, D). centres: (K, D), in the order of the cells that they live in.
    """

    def __init__(self, at: _Points, entries: int, mass: _F64) -> None:
        self._at, self._mass = at, mass
        self.cells = _cells(at, entries, mass)
        self._cell_of, _ = at.nearest(None, _one_list(self.cells), self.cells)
        order = np.argsort(self._cell_of, kind="stable")
        self.centres = at.rows[order[_seeds(mass[order], entries)]]

    def improve(self, refill: bool) -> None:
        """One step: each point to its nearest centre, each centre to the mean of its points.

        Args:
            refill: whether centres that have no point are put where the error is largest.
        """
        self._home()
        labels, scores = self._at.nearest(self._cell_of, _neighbours(self.cells, self._homes), self.centres)
        self.centres = self._at.means(labels, self.centres)
        empty = np.flatnonzero(np.bincount(labels, minlength=len(self.centres)) == 0)
        if refill and len(empty):
            errors = self._mass * np.maximum(self._at.squares + 2.0 * scores, 0)
            # Of equal errors the first one: the same on every machine.
            worst = np.argsort(-errors, kind="stable")[: len(empty)]
            self.centres[empty[: len(worst)]] = self._at.rows[worst]

    def labels(self) -> _U32:
        """The centre of each point; the centres are sorted for it."""
        self._home()
        return self._at.nearest(self._cell_of, _neighbours(self.cells, self._homes), self.centres)[0]

    def _home(self) -> None:
        """Sort the centres by the cells that are nearest to them."""
        homes = self._at.homes(self.cells, self.centres)
        order = np.argsort(homes, kind="stable")
        self._homes, self.centres = homes[order], self.centres[order]


class _Points(Owner):
    """Points and their weights on a device.

    Args:
        device: to compute on.
        rows: (N, D) float32.
        mass: (N,) weights.

    Attributes:
        rows: as given.
        squares: (N,) float64, their squared lengths.
    """

    def __init__(self, device: Device, rows: FloatArray, mass: _F64) -> None:
        self.rows = rows
        self.squares: _F64 = np.einsum("ij,ij->i", rows, rows, dtype=np.float64)
        self._device = device
        self._width = -(-rows.shape[1] // _QUARTER) * _QUARTER
        self._launcher = launcher_for(device, self._width)
        self._means = device.shared_kernel("clustering/means.cl", "means", WIDTH=self._width)
        self._memory = Memory(device)
        try:
            self._points = self._memory.upload(self._padded(rows), "vectors to be clustered")
            self._weights = self._memory.upload(mass.astype(np.float32), "their weights")
            self._labels = self._memory.allocate(4 * len(rows), "the clusters of vectors")
            self._scores = self._memory.allocate(4 * len(rows), "the distances of vectors")
        except BaseException:
            self.close()
            raise

    def nearest(self, cell_of: _U32 | None, lists: _Lists, centres: FloatArray) -> tuple[_U32, FloatArray]:
        """The nearest centre of each point, and |c|² / 2 - x c of it.

        Args:
            cell_of: (N,) of the points; None: there is one cell.
            lists: which centres the points of a cell are compared with.
            centres: (K, D).
        """
        found = _Found(self._labels, self._scores)
        self._compare(self._points, len(self.rows), cell_of, lists, centres, found)
        labels: _U32 = self._device.download(self._labels, (len(self.rows),), np.uint32)
        return labels, self._device.download(self._scores, (len(self.rows),), np.float32)

    def homes(self, cells: FloatArray, centres: FloatArray) -> _U32:
        """(K,) the nearest cell of each centre."""
        if len(cells) == 1:
            return np.zeros(len(centres), np.uint32)
        with Memory(self._device) as memory:
            points = memory.upload(self._padded(centres), "the centres")
            found = _Found(*(memory.allocate(4 * len(centres), "their cells") for _ in range(2)))
            self._compare(points, len(centres), None, _one_list(cells), cells, found)
            homes: _U32 = self._device.download(found.labels, (len(centres),), np.uint32)
            return homes

    def means(self, labels: _U32, centres: FloatArray) -> FloatArray:
        """(K, D), the weighted mean of the points of each label; the centre itself where there are none."""
        order = np.argsort(labels, kind="stable").astype(np.uint32)
        starts = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=len(centres)))]).astype(np.uint32)
        with Memory(self._device) as memory:
            moved = memory.upload(self._padded(centres), "the centres")
            self._means.bind(
                points=self._points,
                weights=self._weights,
                order=memory.upload(order, "the order of clusters"),
                starts=memory.upload(starts, "the first of each cluster"),
                centres=moved,
            ).launch((len(centres) * self._width // _QUARTER,))
            rows = self._device.download(moved, (len(centres), self._width), np.float32)
        return np.ascontiguousarray(rows[:, : centres.shape[1]])

    def _compare(
        self, points: cl.Buffer, count: int, cell_of: _U32 | None, lists: _Lists, centres: FloatArray, found: _Found
    ) -> None:
        order, cells = _blocks(count, cell_of, len(lists.runs_of) - 1, self._launcher.block)
        half_norms = 0.5 * np.einsum("ij,ij->i", centres, centres, dtype=np.float64)
        with Memory(self._device) as memory:
            self._launcher.enqueue(
                len(cells),
                points=points,
                order=memory.upload(order, "the order of vectors"),
                cells=memory.upload(cells, "the cells of vectors"),
                runs_of=memory.upload(lists.runs_of, "the centres of each cell"),
                runs=memory.upload(lists.runs, "the centres of each cell"),
                centres=memory.upload(self._padded(centres), "the centres"),
                half_norms=memory.upload(half_norms.astype(np.float32), "the lengths of centres"),
                labels=found.labels,
                scores=found.scores,
            )
            self._device.queue.finish()

    def _padded(self, rows: FloatArray) -> FloatArray:
        if rows.shape[1] == self._width:
            return np.ascontiguousarray(rows)
        padded = np.zeros((len(rows), self._width), np.float32)
        padded[:, : rows.shape[1]] = rows
        return padded

    def close(self) -> None:
        """Give the device's memory back."""
        self._memory.close()


@dataclass(frozen=True)
class _Found:
    """Where a comparison leaves labels and scores."""

    labels: cl.Buffer
    scores: cl.Buffer


@dataclass(frozen=True)
class _Lists:
    """Which centres the points of each cell are compared with.

    Attributes:
        runs: (R, 2) uint32, first and number of centres in sequence.
        runs_of: (C + 1,) uint32, where the runs of each cell begin, and the end.
    """

    runs: _U32
    runs_of: _U32


def _one_list(centres: FloatArray) -> _Lists:
    """One cell, all centres."""
    return _Lists(np.array([[0, len(centres)]], np.uint32), np.array([0, 1], np.uint32))


def _neighbours(cells: FloatArray, homes: _U32) -> _Lists:
    """For each cell the centres, sorted by their homes, that live in the cells nearest to it."""
    counts = np.bincount(homes, minlength=len(cells))
    firsts = np.cumsum(counts) - counts
    lived_in = np.flatnonzero(counts)
    many = min(_NEIGHBOURS, len(lived_in))
    places = cells.astype(np.float64)
    runs = np.empty((len(cells), many, 2), np.uint32)
    for number, place in enumerate(places):
        away = np.square(places[lived_in] - place).sum(axis=1)
        near = lived_in[np.argsort(away, kind="stable")[:many]]
        runs[number, :, 0], runs[number, :, 1] = firsts[near], counts[near]
    return _Lists(runs.reshape(-1, 2), (np.arange(len(cells) + 1) * many).astype(np.uint32))


def _nearest_of(at: _Points, cells: FloatArray, centres: FloatArray) -> _U32:
    """The nearest of some sorted centres for points that they were not made from."""
    cell_of, _ = at.nearest(None, _one_list(cells), cells)
    return at.nearest(cell_of, _neighbours(cells, at.homes(cells, centres)), centres)[0]


def _cells(at: _Points, entries: int, mass: _F64) -> FloatArray:
    """(C, D) centres of cells that so many centres live in."""
    if entries < _FEW:
        return at.rows[:1]
    count = 2 * math.isqrt(entries)
    sample = _spread(len(at.rows), _MOST_FOR_CELLS)
    rows, some = (at.rows, mass) if sample is None else (at.rows[sample], mass[sample])
    cells = rows[_seeds(some, count)]
    with _Points(at._device, rows, some) as few:
        for _ in range(_CELL_STEPS):
            labels, _scores = few.nearest(None, _one_list(cells), cells)
            cells = few.means(labels, cells)
    return cells


def _seeds(mass: _F64, count: int) -> NDArray[np.intp]:
    """Numbers of ``count`` different points at equal distances in the running sum of a power of their weights."""
    sums = np.cumsum(mass**_SEED_POWER)
    seeds = np.searchsorted(sums, (np.arange(count) + 0.5) / count * sums[-1])
    seeds = np.unique(np.minimum(seeds, len(mass) - 1))
    missing = count - len(seeds)
    if missing:  # points that weigh more than the distance
        free = np.ones(len(mass), bool)
        free[seeds] = False
        others = np.flatnonzero(free)
        seeds = np.sort(np.concatenate([seeds, others[:: max(len(others) // missing, 1)][:missing]]))
    return seeds


def _spread(count: int, most: int) -> NDArray[np.intp] | None:
    """``most`` of ``count`` numbers, evenly; None: there are no more."""
    return None if count <= most else np.arange(most, dtype=np.int64) * count // most


def _blocks(count: int, cell_of: _U32 | None, cells: int, size: int) -> tuple[_U32, _U32]:
    """Points in blocks of ``size``, each of one cell: their numbers (blocks * size,), and the cell of each block."""
    if cell_of is None:
        order = np.full(-(-count // size) * size, _NO_POINT, np.uint32)
        order[:count] = np.arange(count)
        return order, np.zeros(len(order) // size, np.uint32)
    counts = np.bincount(cell_of, minlength=cells)
    blocks = -(-counts // size)
    firsts = (np.cumsum(blocks) - blocks) * size
    by_cell = np.argsort(cell_of, kind="stable")
    sorted_cells = cell_of[by_cell]
    ranks = np.arange(count) - (np.cumsum(counts) - counts)[sorted_cells]
    order = np.full(int(blocks.sum()) * size, _NO_POINT, np.uint32)
    order[firsts[sorted_cells] + ranks] = by_cell
    return order, np.repeat(np.arange(cells, dtype=np.uint32), blocks)
