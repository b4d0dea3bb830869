"""Levels of coefficients chosen by rate and distortion: :func:`chosen_levels`.

Some formats give all coefficients the same fine levels and leave it to a general compressor to make few bytes of them.
What a level takes then follows, roughly, from how often it occurs. So a coefficient whose error matters little takes a
frequent level nearby, and one that matters takes its own: entropy-constrained scalar quantisation (Chou, Lookabaugh,
Gray: "Entropy-constrained vector quantization", 1989), with an error that each coefficient weighs by itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray

U8 = NDArray[np.uint8]

#: Classes of weights, and how many of them a factor of two has.
_CLASSES, _A_DOUBLING = 48, 2
#: The least weight: bits that an error of one level is taken to be worth wherever it is. So what no view shows keeps
#: its colours, only coarsely.
_LEAST = 0.004
#: How the search for the frequencies begins: with every so-manyth level. The best end is taken.
_STARTS = (1, 2, 4, 8, 16)
_ROUNDS = 12
#: Coefficients worked on at a time.
_BLOCK = 1 << 14


class LevelTable:
    """What :func:`chosen_levels` does, with frequencies that some coefficients have told.

    Args:
        levels: (n, K, C), the nearest ones of some coefficients.
        bits_of_error: (n, K), as of :func:`chosen_levels`.
    """

    def __init__(self, levels: U8, bits_of_error: NDArray[np.floating]) -> None:
        pairs = weight_classes(bits_of_error)[..., None] | levels
        self._table = _table(np.bincount(pairs.ravel(), minlength=_CLASSES << 8).reshape(_CLASSES, 256)).ravel()

    def __call__(self, levels: U8, classes: NDArray[np.uint16]) -> U8:
        """The levels to take: (C, n) for nearest levels (C, n), and :func:`weight_classes` (n,) of the weights."""
        chosen: U8 = self._table.take(classes | levels)
        return chosen


def chosen_levels(levels: U8, bits_of_error: FloatArray, threads: int = 0) -> U8:
    """Levels near the given ones that are coded in fewer bits.

    Args:
        levels: (N, K, C), the nearest ones.
        bits_of_error: (N, K): how many bits it is worth to avoid an error of one level, squared errors adding up.
        threads: to work with; the result does not depend on it. 0: one a processor.

    Returns:
        uint8 (N, K, C).
    """
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(levels), _BLOCK)]
    classes = np.empty(bits_of_error.shape, np.uint16)

    def count(block: slice) -> NDArray[np.int64]:
        classes[block] = weight_classes(bits_of_error[block])
        pairs = classes[block, :, None] | levels[block]
        return np.bincount(pairs.ravel(), minlength=_CLASSES << 8)

    chosen = np.empty_like(levels)
    with thread_pool(threads) as pool:
        counts = sum(pool.map(count, blocks), np.zeros(_CLASSES << 8, np.int64))
        table = _table(counts.reshape(_CLASSES, 256)).ravel()

        def choose(block: slice) -> None:
            chosen[block] = table.take(classes[block, :, None] | levels[block])

        list(pool.map(choose, blocks))
    return chosen


def weight_classes(bits_of_error: NDArray[np.floating]) -> NDArray[np.uint16]:
    """The classes of some weights, of their shape; in the higher byte, where a level has room in the lower one."""
    doublings = np.log2(np.maximum(bits_of_error, _LEAST) / np.asarray(_LEAST, bits_of_error.dtype))
    classes: NDArray[np.uint16] = np.minimum(doublings * _A_DOUBLING, _CLASSES - 1).astype(np.uint16)
    return classes << np.uint16(8)


def _table(counts: NDArray[np.int64]) -> U8:
    """(classes, 256) the level to take for each, from how often each class has each level."""
    worth = _LEAST * 2.0 ** ((np.arange(_CLASSES) + 0.5) / _A_DOUBLING)
    apart = np.subtract.outer(np.arange(256.0), np.arange(256.0)) ** 2
    used_classes = np.flatnonzero(counts.any(axis=1))
    some, worth = counts[used_classes].astype(np.float64), worth[used_classes]
    error = (worth[:, None, None] * apart).astype(np.float32)
    best, best_cost = np.arange(256) * np.ones((len(worth), 1), int), np.inf
    for start in _STARTS:
        kept = (np.arange(256) - 128) % start == 0
        frequency = np.bincount(
            128 + ((np.arange(256) - 128 + start // 2) // start) * start, some.sum(axis=0), 256 + 16
        )
        frequency = np.where(kept, frequency[:256], 0)
        for _ in range(_ROUNDS):
            bits = _bits(frequency)
            cost = error + bits
            choice = cost.argmin(axis=2)
            frequency = np.bincount(choice.ravel(), some.ravel(), 256)
        distortion = worth[:, None] * (np.arange(256) - choice) ** 2
        total = float((some * (distortion + _bits(frequency)[choice])).sum())
        if total < best_cost:
            best, best_cost = choice, total
    table = np.tile(np.arange(256), (_CLASSES, 1))
    table[used_classes] = best
    return table.astype(np.uint8)


def _bits(frequency: NDArray[Any]) -> FloatArray:
    """Bits of each level by how often it occurs; many for those that do not."""
    with np.errstate(divide="ignore"):
        bits: NDArray[np.float64] = -np.log2(frequency / frequency.sum())
    return np.minimum(bits, 64).astype(np.float32)
