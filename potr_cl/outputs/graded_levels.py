"""Numbers as levels of a book of 256, coarser where an error matters less: :func:`graded`.

Levels are even steps, so that what a WebP image or any other compressor predicts of them is near. A number whose error
matters little is rounded to every second, fourth or eighth of them: fewer different levels take fewer bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.model.scene import FloatArray

#: A uniform quantiser's error falls by 2 ln 2 of itself for a bit more, and is a twelfth of the squared step: so its
#: step, squared, is this over what an error of 1 is worth in bits.
STEP_OF_BIT = 12 / (2 * np.log(2))
#: The finest steps, as a part of those of a number of mean weight; and the most doublings of them.
_FINEST, _MOST_DOUBLINGS = 0.5, 3
#: Levels of a book, and those that are even at most; the others are for the few numbers beyond.
_LEVELS, _EVEN = 256, 224
#: The part of the numbers on either side that are beyond.
_BEYOND = 0.0005


@dataclass(frozen=True)
class Graded:
    """Numbers as levels.

    Attributes:
        book: (up to 256,) float32, ascending; 0 is in it.
        levels: uint8, of the numbers' shape.
    """

    book: FloatArray
    levels: NDArray[np.uint8]

    @property
    def values(self) -> FloatArray:
        """What readers see."""
        return self.book[self.levels]


def graded(values: FloatArray, worth: FloatArray) -> Graded:
    """Levels for some numbers.

    Args:
        values: (..., C) float32.
        worth: (...,) of an error of 1 in one of the C, squared errors adding up, in bits.
    """
    mean = float(worth.mean(dtype=np.float64))
    low, high = np.quantile(values, [_BEYOND, 1 - _BEYOND])
    finest = _FINEST * np.sqrt(STEP_OF_BIT / mean) if mean > 0 else np.inf
    if high - low > finest * (_EVEN - 2):  # more levels than there are: the best 256
        weights = np.broadcast_to(worth[..., None], values.shape).reshape(-1).astype(np.float64)
        book = _with_zero(codebook(values.reshape(-1), weights, _LEVELS - 1))
        return Graded(book, nearest(values, book).astype(np.uint8))
    if not np.isfinite(finest):
        finest = max(float(high - low), 1.0)
    with np.errstate(divide="ignore"):
        wanted = np.log2(np.sqrt(STEP_OF_BIT / worth.astype(np.float64)) / finest)
    size = finest * 2.0 ** np.clip(np.round(wanted), 0, _MOST_DOUBLINGS)[..., None]
    first, last = np.floor(low / finest), np.ceil(high / finest)
    even = (np.arange(min(first, 0), max(last, 0) + 1) * finest)[:_LEVELS]
    outer = values[(values < even[0] - finest / 2) | (values > even[-1] + finest / 2)]
    beyond = codebook(outer, None, _LEVELS - len(even)) if len(outer) and len(even) < _LEVELS else outer[:0]
    book = np.unique(np.concatenate([even.astype(np.float32), beyond]))
    rounded = np.where((values >= even[0]) & (values <= even[-1]), np.rint(values / size) * size, values)
    return Graded(book, nearest(rounded, book).astype(np.uint8))


def _with_zero(book: FloatArray) -> FloatArray:
    return np.unique(np.concatenate([book, np.zeros(1, np.float32)]))
