"""Interleaved range coding (rANS, Duda 2013) of tokens with static frequencies, many lanes at a time.

Every lane has a state of its own; all lanes take one token in each step and share one stream of 16-bit words. A step is
a handful of array operations over the lanes, so plain numpy decodes tens of millions of tokens a second, and a GPU
could give each lane a work-item. All arithmetic is on integers: the bytes are the same on every machine.
docs/format.md, "Context coder", is the normative description.
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

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


def normalise(counts: I64) -> I64:
    """Counts of tokens to frequencies that add up to :data:`TOTAL`; no token that occurs gets 0.

    Args:
        counts: (A,), at most 256, at least one above 0.
    """
    present = counts > 0
    frequencies: I64 = np.where(present, np.maximum(counts * TOTAL // int(counts.sum()), 1), 0)
    # What rounding left over goes to the token whose code it changes most for the better, or least for the worse.
    while rest := TOTAL - int(frequencies.sum()):
        if rest > 0:
            frequencies[np.argmax(np.where(present, counts / np.maximum(frequencies, 1), -1))] += -(-rest // 4)
        else:
            frequencies[np.argmin(np.where(frequencies > 1, counts / np.maximum(frequencies, 1), np.inf))] -= 1
    return frequencies


class Encoder:
    """Codes steps in the reverse of the order in which a :class:`Decoder` gives them back."""

    def __init__(self, lanes: int) -> None:
        self.states = np.full(lanes, LOWEST, np.int64)
        self._words: list[bytes] = []

    def step(self, frequencies: I64, starts: I64) -> None:
        """Code one token in each of the first lanes.

        Args:
            frequencies: of the lanes' tokens in their contexts.
            starts: sums of the frequencies of the tokens before them.
        """
        active = self.states[: len(frequencies)]
        full = np.flatnonzero(active >= frequencies << (32 - PRECISION))
        if len(full):
            overflowing = active[full]
            self._words.append(overflowing.astype("<u2").tobytes())
            active[full] = overflowing >> 16
        quotients = active // frequencies
        active += quotients * (TOTAL - frequencies) + starts

    def words(self) -> bytes:
        """The words in the order in which a decoder takes them."""
        return b"".join(reversed(self._words))


class Decoder:
    """Gives tokens back, step by step.

    Args:
        states: (L,) as the encoder left them.
        words: little-endian 16-bit words.
        what: for messages.
    """

    def __init__(self, states: I64, words: bytes | memoryview, what: str) -> None:
        self._states = states
        self._words = np.frombuffer(words, "<u2").astype(np.int64)
        self._read = 0
        self._what = what
        self._slots = np.empty(len(states), np.int64)
        self._entries = np.empty(len(states), np.int64)

    def step(self, table: I64, contexts: I64, out: U8) -> None:
        """Decode one token in each of the first lanes.

        Args:
            table: from :func:`decoding_table`.
            contexts: (lanes,) number of each lane's context, times :data:`TOTAL`.
            out: (lanes,), takes the tokens.

        Raises:
            DataError: no words are left.
        """
        lanes = len(out)
        states, slots, entries = self._states[:lanes], self._slots[:lanes], self._entries[:lanes]
        np.bitwise_and(states, TOTAL - 1, out=slots)
        slots += contexts
        table.take(slots, out=entries, mode="clip")
        out[:] = entries  # the token is the entry's lowest byte
        states >>= PRECISION
        np.right_shift(entries, 8 + PRECISION, out=slots)
        states *= slots
        entries >>= 8
        entries &= TOTAL - 1
        states += entries
        (low,) = (states < LOWEST).nonzero()
        if len(low):
            words = self._words[self._read : self._read + len(low)]
            if len(words) < len(low):
                raise DataError(f"section '{self._what}' ends too early")
            states[low] = states[low] << 16 | words
            self._read += len(low)

    def finish(self) -> None:
        """Check that all words were taken and every lane is back where its encoder began.

        Raises:
            DataError: they are not.
        """
        if self._read != len(self._words) or (self._states != LOWEST).any():
            raise DataError(f"section '{self._what}' does not end where its last token does")


def decoding_table(frequencies: I64) -> I64:
    """For each context and each residue of a state: frequency << 20 | residue within the token << 8 | token.

    Args:
        frequencies: (contexts, A), every row adding up to :data:`TOTAL`.
    """
    contexts, alphabet = frequencies.shape
    flat = frequencies.ravel()
    tokens = np.repeat(np.tile(np.arange(alphabet), contexts), flat)
    starts = (np.cumsum(frequencies, axis=1) - frequencies).ravel()
    residues = np.tile(np.arange(TOTAL), contexts) - np.repeat(starts, flat)
    table: I64 = np.repeat(flat, flat) << (8 + PRECISION) | residues << 8 | tokens
    return table
