"""Few numbers that stand for many, :func:`codebook`: weighted k-means in one dimension.

In one dimension the clusters are intervals, so that a step of Lloyd's algorithm is a search in sorted numbers and
differences of running sums: no device is needed for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.order import ascending
from potr_cl.model.scene import FloatArray

_F64 = NDArray[np.float64]

#: Steps of Lloyd's algorithm at most; it has moved little after far fewer.
_STEPS = 60
#: It begins with intervals that hold equal parts of this power of the density's: what is best for many entries.
_DENSITY_POWER = 1 / 3
#: Parts of the histogram from which the density is taken: few where it is even, many where it has a peak. The best end
#: is taken.
_BINS = (256, 1024, 4096)
#: Digits of an entry: as many as its error asks for and few more, since files hold entries as text.
_DIGITS = 6


def codebook(values: FloatArray, weights: _F64 | None, entries: int) -> FloatArray:
    """Numbers from which each value is little away.

    Args:
        values: (n,) float32, finite.
        weights: (n,) of the squared errors, 0 or more; None: all alike.
        entries: the most numbers that it may have.

    Returns:
        (at most ``entries``,) float32, ascending, of few decimal digits; the values themselves where there are no more
        different ones.
    """
    with thread_pool() as pool:
        order = ascending(values, pool.map)
    in_order = values[order]
    first = np.flatnonzero(np.concatenate([[True], in_order[1:] != in_order[:-1]]))
    distinct = in_order[first].astype(np.float64)
    if len(distinct) <= entries:
        return distinct.astype(np.float32)
    each = np.ones(len(values)) if weights is None else weights[order].astype(np.float64)
    each = np.maximum(each, each.mean() * 1e-9 or 1.0)  # of numbers that count for nothing the nearest is taken too
    mass = np.add.reduceat(each, first)
    ends = [_descended(distinct, mass, _first_centres(distinct, mass, entries, bins)) for bins in _BINS]
    best = min(ends, key=lambda end: end[1])[0]
    return np.unique(_rounded(best))


def nearest(values: FloatArray, book: FloatArray) -> NDArray[np.intp]:
    """The number of the entry of ``book``, (entries,) ascending, that is nearest to each value; of their shape."""
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(middles, values, side="left")


def _descended(distinct: _F64, mass: _F64, centres: _F64) -> tuple[_F64, float]:
    """Centres after Lloyd's algorithm, ascending, and their error."""
    masses = np.concatenate([[0.0], np.cumsum(mass)])
    moments = np.concatenate([[0.0], np.cumsum(mass * distinct)])
    for _ in range(_STEPS):
        ends = np.searchsorted(distinct, (centres[1:] + centres[:-1]) / 2)
        bounds = np.concatenate([[0], ends, [len(distinct)]])
        inside = masses[bounds[1:]] - masses[bounds[:-1]]
        sums = moments[bounds[1:]] - moments[bounds[:-1]]
        moved = np.where(bounds[1:] > bounds[:-1], sums / np.where(inside > 0, inside, 1), centres)
        if np.array_equal(moved, centres):
            break
        centres = np.sort(moved)
    own = np.searchsorted((centres[1:] + centres[:-1]) / 2, distinct)
    return centres, float((mass * np.square(distinct - centres[own])).sum())


def _first_centres(distinct: _F64, mass: _F64, entries: int, bins: int) -> _F64:
    """Ascending centres of intervals that hold equal parts of a power of the density."""
    low, high = distinct[0], distinct[-1]
    counts, edges = np.histogram(distinct, bins, (low, high), weights=mass)
    growth = np.concatenate([[0.0], np.cumsum(counts**_DENSITY_POWER)])
    centres: _F64 = np.interp((np.arange(entries) + 0.5) / entries * growth[-1], growth, edges)
    return centres


def _rounded(values: _F64) -> FloatArray:
    """To few significant digits."""
    return np.array([float(f"{value:.{_DIGITS}g}") for value in values], np.float32)
