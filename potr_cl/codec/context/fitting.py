"""Finds a scene's model: weights by least squares, contexts and their frequencies by what they save.

Works for the encoder of sections (:mod:`potr_cl.codec.context.encoder`), which gives it tokens and their sizes in
(steps, lanes).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import rans
from potr_cl.codec.context.model import CHANNELS, LARGEST_SIZE, MOST_CONTEXTS, TERMS, Model
from potr_cl.codec.native.library import native

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

#: Weights are in units of 2 to the power of minus this.
_WEIGHT_BITS = 8
#: Splats whose products are added at a time.
_COLUMNS = 1 << 11
#: Bits that storing one frequency costs, about.
_FREQUENCY_BITS = 7


def recent_sizes(sizes: I32) -> I32:
    """About 8 times the mean size of a lane's last splats, before each; all are (streams, steps, lanes)."""
    functions = native()
    if functions is not None:
        return functions.recent_sizes(sizes)
    recent = np.empty_like(sizes)
    recent[:, 0] = 0
    twice = sizes << 1
    part = np.empty((len(sizes), sizes.shape[2]), np.int32)
    for t in range(1, sizes.shape[1]):
        r, after = recent[:, t - 1], recent[:, t]
        np.right_shift(r, 2, part)
        np.subtract(r, part, after)
        np.add(after, twice[:, t - 1], after)
    return recent


def fit_weights(sums: list[I32], sizes: I32, recents: I32, fitted: I64) -> NDArray[np.int16]:
    """Least-squares weights for the sizes of a coefficient's channels.

    Args:
        sums: what is known from the coefficients before, (steps, lanes) each.
        sizes, recents: (channels, steps, lanes) sizes and recent ones.
        fitted: flat indices of what to fit to.

    Returns:
        (channels, terms) in the order of the format.
    """
    channels = len(sizes)
    terms = [*sums, *sizes, *recents]
    columns = np.zeros((-(-len(fitted) // _COLUMNS), len(terms) + 1, _COLUMNS))
    whole, rest = divmod(len(fitted), _COLUMNS)
    for k, term in enumerate(terms):
        values = term.ravel().take(fitted)
        columns[:whole, k] = values[: whole * _COLUMNS].reshape(whole, _COLUMNS)
        columns[whole:, k, :rest] = values[whole * _COLUMNS :]
    columns[:whole, -1] = 1
    columns[whole:, -1, :rest] = 1
    # Sums of products of integers, below 2^53: exact, in whatever order they are added. Few columns at a time stay in a
    # cache and do not wake the threads of a BLAS, which would stand in the way of those here.
    products = (columns @ columns.transpose(0, 2, 1)).sum(axis=0)
    weights = np.zeros((channels, TERMS), np.int16)
    for c in range(channels):
        known = [*range(CHANNELS + c), CHANNELS + channels + c, -1]
        gram = products[np.ix_(known, known)]
        gram[np.diag_indices_from(gram)] *= 1 + 1e-6
        gram[np.diag_indices_from(gram)] += 1e-6 * len(fitted)
        solution = np.round(np.linalg.solve(gram, products[known, CHANNELS + c]) * (1 << _WEIGHT_BITS))
        cut = np.clip(solution, -32768, 32767)
        weights[c, : CHANNELS + c] = cut[:-2]
        weights[c, -2:] = cut[-2:]
    return weights


def cells_of(terms: list[I32], weights: NDArray[np.int16], tokens: U8, alphabet: int, block: int) -> U16:
    """(steps, lanes) expected size · alphabet + token.

    Args:
        terms: known sizes and recent ones, (steps, lanes) each.
        weights: of the terms, in the order of the format.
        tokens: (steps, lanes).
        alphabet: more than the largest token.
        block: sizes worked on at a time.
    """
    used = [(term, np.int32(w)) for term, w in zip(terms, [*weights[: len(terms) - 1], weights[-2]], strict=True) if w]
    functions = native()
    if functions is not None:
        return functions.cells([t for t, _ in used], [int(w) for _, w in used], int(weights[-1]), tokens, alphabet)
    cells = np.empty(tokens.shape, np.uint16)
    rows = max(block // tokens.shape[1], 1)
    for start in range(0, len(tokens), rows):
        part = slice(start, start + rows)
        expected = np.full(cells[part].shape, weights[-1], np.int32)
        for term, weight in used:
            expected += weight * term[part]
        expected >>= _WEIGHT_BITS
        np.clip(expected, 0, LARGEST_SIZE, out=expected)
        expected *= alphabet
        expected += tokens[part]
        cells[part] = expected
    return cells


def fit_model(streams: list[U16], idle: I64, alphabet: int) -> Model:
    """Classes of expected sizes and their frequencies: fine ones first, merged while that saves bytes.

    Args:
        streams: cells.
        idle: flat indices of those that stand for no splat.
        alphabet: of the cells.
    """
    cells = (LARGEST_SIZE + 1) * alphabet
    functions = native()
    if functions is None:
        counts = np.zeros(cells, np.int64)
        for stream in streams:
            counts += np.bincount(stream.ravel(), minlength=cells)
    else:
        counts = functions.count_cells(streams, cells)
    for stream in streams:
        counts -= np.bincount(stream.ravel()[idle], minlength=cells)
    by_size = counts.reshape(-1, alphabet)
    used = np.flatnonzero(by_size.any(axis=1))
    ranks = np.cumsum(by_size[used].sum(axis=1))
    edges = used[np.flatnonzero(np.diff((ranks - 1) * 2 * MOST_CONTEXTS // ranks[-1], prepend=-1))]
    starts: list[int] = [0, *edges[1:].tolist()]
    groups = list(np.add.reduceat(by_size, starts))
    costs = [_cost(g) for g in groups]
    merged = [_cost(a + b) for a, b in pairwise(groups)]
    while len(groups) > 1:
        growth = [m - a - b for m, a, b in zip(merged, costs, costs[1:], strict=False)]
        k = growth.index(min(growth))
        if growth[k] >= 0 and len(groups) <= MOST_CONTEXTS:
            break
        groups[k : k + 2] = [groups[k] + groups[k + 1]]
        costs[k : k + 2] = [merged.pop(k)]
        del starts[k + 1]
        for pair in range(max(k - 1, 0), min(k + 1, len(merged))):
            merged[pair] = _cost(groups[pair] + groups[pair + 1])
    classes = np.zeros(LARGEST_SIZE + 1, np.uint8)
    for start in starts[1:]:
        classes[start:] += 1
    return Model(classes, np.array([rans.normalise(g) for g in groups]))


def _cost(counts: I64) -> float:
    """Bits of the tokens of a context and of its frequencies."""
    present = counts[counts > 0].astype(np.float64)
    return float(np.add.reduce(present * np.log2(np.add.reduce(present) / present))) + _FREQUENCY_BITS * len(present)
