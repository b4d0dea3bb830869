"""Interleaved range coding (rANS, Duda 2013): what all who code by it have in common.

Every lane has a state of its own, and lanes share a stream of 16-bit words. docs/format.md, "Bundles", is the normative
description.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError

#: The frequencies of a context add up to two to the power of this.
PRECISION = 12
TOTAL = 1 << PRECISION
#: A state is at or above this between steps, and below it times 2^16; coding starts and decoding ends with it.
LOWEST = 1 << 16
#: What divides the sums that tell contexts, as a power of two.
CONTEXT_SHIFT = 8

I64 = NDArray[np.int64]


def normalise(counts: I64) -> I64:
    """Counts of tokens to frequencies that add up to :data:`TOTAL`; no token that occurs gets 0.

    Args:
        counts: (A,), at most 256, at least one above 0.
    """
    present = counts > 0
    frequencies: I64 = np.where(present, np.maximum(counts * TOTAL // int(counts.sum()), 1), 0)
    # What rounding left over goes to the token whose code it changes most for the better, or least for the worse.
    rest = TOTAL - int(frequencies.sum())
    gains = np.where(present, counts / np.maximum(frequencies, 1), -1)
    while rest > 0:
        token = gains.argmax()
        more = -(-rest // 4)
        frequencies[token] += more
        rest -= more
        gains[token] = counts[token] / frequencies[token]
    losses = np.where(frequencies > 1, counts / np.maximum(frequencies, 1), np.inf)
    while rest < 0:
        token = losses.argmin()
        frequencies[token] -= 1
        rest += 1
        losses[token] = counts[token] / frequencies[token] if frequencies[token] > 1 else np.inf
    return frequencies


def no_words_left(what: str) -> DataError:
    """What to raise where a lane needs a word and there is none; ``what`` is the section, for the message."""
    return DataError(f"section '{what}' ends too early")


def check_end(all_words: bool, states: NDArray[np.unsignedinteger], what: str) -> None:
    """Check that all words were taken and every lane is back where its encoder began.

    Args:
        all_words: whether they were.
        states: (lanes,) of the decoder.
        what: was decoded, for the message.

    Raises:
        DataError: they are not.
    """
    if not all_words or (states != LOWEST).any():
        raise DataError(f"section '{what}' does not end where its last token does")
