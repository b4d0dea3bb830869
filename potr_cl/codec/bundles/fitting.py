"""Finds what a section says of its streams: weights by least squares, contexts and frequencies by what they save.

All decisions that the bytes depend on are taken on integers, but for the solution of the least squares, which is
rounded, so that NumPy and the native path find the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles import streams
from potr_cl.codec.bundles.description import LARGEST_SIZE, MOST_CONTEXTS, Model
from potr_cl.codec.bundles.layout import Layout

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

#: Items to which weights are fitted, about, and of a bundle at least.
_FITTED, _FEWEST = 1 << 14, 16
#: Weights are in units of 2 to the power of minus this.
_WEIGHT_BITS = 8
#: Fractional bits of logarithms, and how many integers have one of their own.
_LOG_BITS, _LOGS = 16, 1 << 12
#: Bits that storing one frequency costs, about.
_FREQUENCY_BITS = 7 << _LOG_BITS


def recent_sizes(layout: Layout, sizes: I64) -> I64:
    """(items,) about 8 times the mean size of the last items in the lane, before each."""
    rows = layout.laid(sizes)
    recent = np.zeros_like(rows)
    for before, size, after in zip(recent, rows, recent[1:], strict=False):
        np.subtract(before, before >> 2, out=after)
        after += 2 * size
    return layout.taken(recent)


def samples(counts: I64) -> I64:
    """Which of a stream's items weights are fitted to, by the items of each bundle: some of each bundle."""
    every = np.maximum(counts // samples_of_bundle(len(counts)), 1)
    starts = np.cumsum(counts) - counts
    place = np.arange(int(counts.sum())) - np.repeat(starts, counts)
    return np.flatnonzero(place % np.repeat(every, counts) == 0)


def samples_of_bundle(bundles: int) -> int:
    """How many a bundle has at least, where it has as many items."""
    return max(_FITTED // bundles, _FEWEST)


def products(columns: Sequence[I64], which: I64 | None, coefficients: int, sizes: I64) -> I64:
    """Sums of products of terms, recent sizes, constant, coefficients and size, in this order.

    Args:
        columns: terms and recent sizes, (items,) each.
        which: (items,) coefficients, for a stream that has biases.
        coefficients: how many there are.
        sizes: (items,) of the tokens.
    """
    rows = [*columns, np.ones(len(sizes), np.int64)]
    if which is not None:
        rows += [(which == k).astype(np.int64) for k in range(coefficients)]
    # Below 2^53: exact, in whatever order they are added.
    matrix = np.array([*rows, sizes], np.float64)
    made: I64 = (matrix @ matrix.T).astype(np.int64)
    return made


def solve(gram: I64) -> I64:
    """The numbers of a stream (:class:`potr_cl.codec.bundles.description.Fitted`), by least squares.

    Args:
        gram: as of :func:`products`; what is below the diagonal does not count.
    """
    full = np.triu(gram).astype(np.float64)
    full += np.triu(full, 1).T
    left, target = full[:-1, :-1], full[:-1, -1]
    diagonal = np.diag_indices_from(left)
    left[diagonal] *= 1 + 1e-6
    left[diagonal] += 1e-2
    solution = np.round(np.linalg.solve(left, target) * (1 << _WEIGHT_BITS))
    numbers: I64 = np.clip(solution, -32768, 32767).astype(np.int64)
    return numbers


def expected_sizes(columns: Sequence[I64], which: I64 | None, numbers: I64) -> I64:
    """(items,) expected sizes, 0 to 255."""
    terms = len(columns)
    expected = np.full(len(columns[-1]), numbers[terms], np.int64)
    for column, weight in zip(columns, numbers.tolist(), strict=False):
        if weight:
            expected += weight * column
    if which is not None:
        expected += numbers[terms + 1 :][which]
    cut: I64 = np.clip(expected >> _WEIGHT_BITS, 0, LARGEST_SIZE)
    return cut


def fit_model(cells: U16, alphabet: int) -> Model:
    """Classes of expected sizes and their frequencies: fine ones first, merged while that saves bytes.

    Args:
        cells: (items,) expected size · alphabet + token, at least one.
        alphabet: more than the largest token.
    """
    by_size = np.bincount(cells, minlength=(LARGEST_SIZE + 1) * alphabet).reshape(-1, alphabet)
    used = np.flatnonzero(by_size.any(axis=1))
    ranks = np.cumsum(by_size[used].sum(axis=1))
    edges = used[np.flatnonzero(np.diff((ranks - 1) * 2 * MOST_CONTEXTS // ranks[-1], prepend=-1))]
    starts = [0, *edges[1:].tolist()]
    groups = np.add.reduceat(by_size, starts)
    starts, groups = merge(starts, groups)
    classes = np.zeros(LARGEST_SIZE + 1, np.uint8)
    for start in starts[1:]:
        classes[start:] += 1
    return Model(classes, np.array([streams.normalise(group) for group in groups]))


def merge(starts: list[int], groups: I64) -> tuple[list[int], I64]:
    """Merge neighbours of some groups of counts while that saves bytes, or there are too many.

    Args:
        starts: of each group.
        groups: (groups, alphabet) counts.
    """
    starts = list(starts)
    left = list(groups)
    costs = list(_costs(groups))
    merged = list(_costs(groups[:-1] + groups[1:]))
    while len(left) > 1:
        growth = [m - a - b for m, a, b in zip(merged, costs, costs[1:], strict=False)]
        k = growth.index(min(growth))
        if growth[k] >= 0 and len(left) <= MOST_CONTEXTS:
            break
        left[k : k + 2] = [left[k] + left[k + 1]]
        costs[k : k + 2] = [merged.pop(k)]
        del starts[k + 1]
        pairs = range(max(k - 1, 0), min(k + 1, len(merged)))
        if len(pairs):
            merged[pairs.start : pairs.stop] = _costs(np.array([left[p] + left[p + 1] for p in pairs]))
    return starts, np.array(left)


def _costs(groups: I64) -> I64:
    """Of each context: bits of its tokens and of its frequencies, in units of 2^-16."""
    totals = groups.sum(axis=1)
    spent = totals * _logarithms(totals) - (groups * _logarithms(groups)).sum(axis=1)
    costs: I64 = spent + _FREQUENCY_BITS * np.count_nonzero(groups, axis=1)
    return costs


def _logarithms(numbers: I64) -> I64:
    """log₂ of counts, of 0 0: from a table of the 12 highest bits."""
    shift = np.maximum(np.frexp(numbers.astype(np.float64))[1] - 12, 0)
    logarithms: I64 = log_table()[numbers >> shift] + (shift.astype(np.int64) << _LOG_BITS)
    return logarithms


@lru_cache(maxsize=1)
def log_table() -> I64:
    """(4096,) log₂ of each number, in units of 2^-16; of 0 0."""
    table = np.zeros(_LOGS, np.int64)
    table[1:] = np.round(np.log2(np.arange(1, _LOGS)) * (1 << _LOG_BITS))
    return table
