"""Few vectors that stand for many, :func:`cluster`: weighted k-means on a device.

Comparing every point with every centre takes N K D operations a step: for a million splats and a palette of 65536 sets
of SH coefficients that is a minute on two cores, ten times over. So there are two levels. Some hundred coarse cells are
found first. Each centre lives in the cell that is nearest to it, and a point is compared with those centres alone that
live in the cells next to its own (:data:`_NEIGHBOURS`), and with those that most points have.

Where entries and labels take bytes, both count as distance (P. A. Chou, T. Lookabaugh, R. M. Gray: "Entropy-constrained
vector quantization", 1989): a label takes the bits that follow from how many points have it, an entry is paid for by
the points that have it, and an entry without points goes.

All choices are made in a fixed order: a device gives the same bits on every run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.comparison import (
    U32,
    Lists,
    Points,
    centres_of_sums,
    errors_at_zero,
    rows_of_points,
    sorted_by_label,
)
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner

_F64 = NDArray[np.float64]

#: Cells whose centres a point is compared with: its own and those next to it.
_NEIGHBOURS = 8
#: Centres that most points have, with which all points are compared where labels take bits.
_POPULAR = 64
#: Cells whose neighbours a thread finds at a time.
_CELLS_AT_ONCE = 32
#: Fewer centres than this are one cell.
_FEW = 512
#: Steps of Lloyd's algorithm: for the cells, and by default for the centres.
_CELL_STEPS, STEPS = 6, 8
#: Points that centres are found from at most, and that cells are: each stands for its neighbours in the scene's order.
_MOST, _MOST_FOR_CELLS = 1 << 20, 1 << 16
#: Seeds are as dense as this power of the points' errors: what is best for vectors of some ten dimensions that matter.
_SEED_POWER = 0.8


@dataclass(frozen=True)
class Rate:
    """What entries and labels take, in bits; distances are in bits then too.

    Attributes:
        entry: an entry of the palette.
    """

    entry: float


@dataclass(frozen=True)
class Clusters:
    """Centres, and the one of each point.

    Attributes:
        centres: (K, G, C) float32.
        labels: (N,) uint32, a number of a centre for each point.
    """

    centres: FloatArray
    labels: U32


def cluster(
    device: Device, points: FloatArray, weights: FloatArray, entries: int, rate: Rate | None = None
) -> Clusters:
    """Find centres from which the points are little away, by the weighted sum of their squared distances.

    Args:
        device: to compute on.
        points: (N, G, C) float32, finite: C coordinates in each of G groups; neighbours are best alike, as many seeds
            are taken in their order.
        weights: (N, G) float32, 0 or more.
        entries: K, the most centres there may be, 1 or more.
        rate: what entries and labels take; None: nothing.
    """
    with _Finder(device, points, weights, entries, rate) as finder:
        for step in range(STEPS):
            finder.improve(refill=rate is None and step < STEPS - 1)
        return finder.clusters()


def assigned(
    device: Device, points: FloatArray, weights: FloatArray, centres: FloatArray, bits: FloatArray | None = None
) -> U32:
    """(N,) uint32, the best of given centres for each point; see :func:`cluster`.

    Args:
        device, points, weights: as of :func:`cluster`.
        centres: (K, G, C).
        bits: (K,) what each label takes; None: nothing.
    """
    cells = _cells(device, centres, np.ones(centres.shape[:2], np.float32), len(centres))
    return _in_parts(device, points, weights, _Homed.of(device, centres, bits, cells))


@dataclass(frozen=True)
class _Homed:
    """Centres in the cells that they live in, and the lists that follow.

    Attributes:
        cells: (C, G, C'). centres: sorted by the cells, popular ones behind once more. biases: of these.
        numbers: (K + P,) of the centres as they were given.
    """

    cells: FloatArray
    centres: FloatArray
    biases: FloatArray
    numbers: NDArray[np.int64]
    lists: Lists

    @staticmethod
    def of(device: Device, centres: FloatArray, bits: FloatArray | None, cells: FloatArray) -> _Homed:
        """Find the cell of each centre.

        Args:
            bits: (K,) of the labels; None: they take none, and none is popular.
        """
        if len(cells) == 1:
            homes = np.zeros(len(centres), np.uint32)
        else:
            with Points(device, rows_of_points(centres, np.ones(centres.shape[:2], np.float32))) as at:
                homes, _ = at.nearest(cells)
        numbers = np.argsort(homes, kind="stable")
        popular = 0
        if bits is not None and len(cells) > 1:
            popular = min(_POPULAR, len(centres))
            numbers = np.concatenate([numbers, np.argsort(bits, kind="stable")[:popular]])
        lists = _neighbours(cells, homes, popular)
        biases = np.zeros(len(numbers), np.float32) if bits is None else bits[numbers]
        return _Homed(cells, centres[numbers], biases, numbers, lists)

    def nearest(self, at: Points) -> tuple[U32, FloatArray]:
        """The best centre of each point, by its number as it was given, and its score."""
        cells = None if len(self.cells) == 1 else at.nearest(self.cells)[0]
        labels, scores = at.nearest(self.centres, self.biases, cells, self.lists)
        return self.numbers[labels].astype(np.uint32), scores


class _Finder(Owner):
    """Centres of some points, step by step."""

    def __init__(
        self, device: Device, points: FloatArray, weights: FloatArray, entries: int, rate: Rate | None
    ) -> None:
        self._device, self._points, self._weights, self._rate = device, points, weights, rate
        sample = _spread(len(points), _MOST)
        taken = points if sample is None else points[sample]
        mass = weights if sample is None else weights[sample]
        self._each = len(points) / len(taken)
        mass = np.maximum(mass, np.float32(mass.mean(dtype=np.float64) * 1e-6) or np.float32(1))
        self._taken, self._constants = taken, errors_at_zero(taken, mass)
        count = min(entries, len(taken))
        cells = _cells(device, taken, mass, count)
        with device.all_or_nothing():
            self._at = Points(device, rows_of_points(taken, mass))
            cell_of, scores = self._at.nearest(cells)
            errors = np.maximum(self._constants + scores, 0)
            errors += errors.mean() * 1e-3 or 1.0  # where all points are alike, too
            order = sorted_by_label(cell_of, len(cells))
            self._centres = taken[order[_seeds(errors[order], count)]]
            self._cells = cells
            self._held = None
            if rate is not None:  # what is all zero takes few bits
                self._held = 0
                self._centres[0] = 0
            self._bits = None if rate is None else np.full(count, math.log2(count), np.float32)

    def improve(self, refill: bool) -> None:
        """One step: each point to its best centre, each centre to the mean of its points.

        Args:
            refill: whether centres that have no point are put where the error is largest.
        """
        labels, scores = _Homed.of(self._device, self._centres, self._bits, self._cells).nearest(self._at)
        count = len(self._centres)
        self._centres = centres_of_sums(self._at.sums(labels, count), self._centres)
        having = np.bincount(labels, minlength=count)
        if self._rate is not None:
            self._centres[0] = 0
            kept = having > 0
            kept[0] = True
            self._centres, self._bits = self._centres[kept], self._rates(having[kept])
        elif refill and not having.all():
            empty = np.flatnonzero(having == 0)
            # Of equal errors the first one: the same on every machine.
            worst = np.argsort(-(self._constants + scores), kind="stable")[: len(empty)]
            self._centres[empty[: len(worst)]] = self._taken[worst]

    def _rates(self, having: NDArray[np.intp]) -> FloatArray:
        """(K,) bits of a label, with the part of its entry that a point pays for."""
        assert self._rate is not None
        several = np.maximum(having, 1)
        paid = np.where(np.arange(len(having)) > 0, self._rate.entry / (several * self._each), 0)
        bits: FloatArray = (np.log2(several.sum() / several) + paid).astype(np.float32)
        return bits

    def clusters(self) -> Clusters:
        """The centres and the labels of all points."""
        homed = _Homed.of(self._device, self._centres, self._bits, self._cells)
        return Clusters(self._centres, _in_parts(self._device, self._points, self._weights, homed))

    def close(self) -> None:
        self._at.close()


def _in_parts(device: Device, points: FloatArray, weights: FloatArray, homed: _Homed) -> U32:
    """The best centre of each point, some points at a time."""
    labels = np.empty(len(points), np.uint32)
    for start in range(0, len(points), _MOST):
        some = slice(start, start + _MOST)
        with Points(device, rows_of_points(points[some], weights[some])) as at:
            labels[some], _ = homed.nearest(at)
    return labels


def _cells(device: Device, points: FloatArray, weights: FloatArray, entries: int) -> FloatArray:
    """(C, G, C') centres of cells that so many centres live in."""
    if entries < _FEW:
        return points[:1]
    count = min(2 * math.isqrt(entries), len(points))
    sample = _spread(len(points), _MOST_FOR_CELLS)
    some, mass = (points, weights) if sample is None else (points[sample], weights[sample])
    cells = some[_seeds(errors_at_zero(some, mass) + 1e-30, count)]
    with Points(device, rows_of_points(some, mass)) as few:
        for _ in range(_CELL_STEPS):
            labels, _scores = few.nearest(cells)
            cells = centres_of_sums(few.sums(labels, count), cells)
    return cells


def _neighbours(cells: FloatArray, homes: U32, popular: int) -> Lists:
    """For each cell the centres, sorted by their homes, of the cells nearest to it; and so many that stand behind."""
    counts = np.bincount(homes, minlength=len(cells))
    firsts = np.cumsum(counts) - counts
    lived_in = np.flatnonzero(counts)
    many = min(_NEIGHBOURS, len(lived_in))
    places = cells.reshape(len(cells), -1).astype(np.float64)
    others = places[lived_in]
    runs = np.empty((len(cells), many + (popular > 0), 2), np.uint32)

    def find(start: int) -> None:
        some = slice(start, start + _CELLS_AT_ONCE)
        away = np.square(others - places[some, None]).sum(axis=2)
        near = lived_in[np.argsort(away, axis=1, kind="stable")[:, :many]]
        runs[some, :many, 0], runs[some, :many, 1] = firsts[near], counts[near]

    with thread_pool() as pool:
        list(pool.map(find, range(0, len(places), _CELLS_AT_ONCE)))
    if popular:
        runs[:, many] = len(homes), popular
    return Lists(runs.reshape(-1, 2), (np.arange(len(cells) + 1) * runs.shape[1]).astype(np.uint32))


def _seeds(mass: _F64, count: int) -> NDArray[np.intp]:
    """Numbers of ``count`` different points at equal distances in the running sum of a power of ``mass``."""
    sums = np.cumsum((mass / mass.max()) ** _SEED_POWER)
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
