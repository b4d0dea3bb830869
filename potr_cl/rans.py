"""Interleaved range coding (rANS, Duda 2013) of tokens with static frequencies, many lanes at a time.

Every lane has a state of its own; all lanes take one token in each step and share one stream of 16-bit words. A step is
a handful of array operations over the lanes, so plain numpy decodes tens of millions of tokens a second, and a GPU
could give each lane a work-item. All arithmetic is on integers: the bytes are the same on every machine.
docs/format.md, "Context coder", is the normative description.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError

#: The frequencies of a context add up to two to the power of this.
PRECISION = 12
TOTAL = 1 << PRECISION
#: A state is at or above this between steps, and below it times 2^16; coding starts and decoding ends with it.
LOWEST = 1 << 16
#: Tokens that an encoder prepares at a time: few enough for their frequencies to stay in a cache.
_BLOCK = 1 << 15

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]


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


@dataclass(frozen=True)
class Tokens:
    """What is coded into one stream of words, for :func:`encode`.

    Attributes:
        cells: one array a stream, in the order of decoding: (T, L) uint16, each lane's token in each step as context ·
            A + token, or contexts · A where a lane has none.
        models: which of ``frequencies`` each stream has.
        frequencies: (contexts, A) each, every row adding up to :data:`TOTAL`.
    """

    cells: Sequence[U16]
    models: Sequence[int]
    frequencies: Sequence[I64]


def encode(sections: Sequence[Tokens]) -> list[tuple[NDArray[np.uint32], bytes]]:
    """Code some sections side by side: each comes out as if it were alone, but small ones share numpy's calls.

    Args:
        sections: not none; with the same T and L.

    Returns:
        The (L,) states and the words of each, as a :class:`Decoder` takes them.
    """
    # The last token is coded first. The sections with the most streams come first, so that those at work are the first.
    ranked = sorted(range(len(sections)), key=lambda i: -len(sections[i].cells))
    steps, lanes = sections[0].cells[0].shape
    bases, frequencies, starts = _tables([sections[i] for i in ranked])
    # Integers below 2^53 are exact in float64, and so is the floor of a quotient of two below 2^32; unlike integers',
    # divisions of floats are vector operations.
    all_states = np.full(len(ranked) * lanes, LOWEST, np.float64)
    words: list[list[bytes]] = [[] for _ in ranked]
    for back in range(1, len(sections[ranked[0]].cells) + 1):
        at_work = [sections[i] for i in ranked if len(sections[i].cells) >= back]
        states = all_states[: len(at_work) * lanes]
        quotients, large = np.empty_like(states), np.empty(len(states), bool)
        most = np.full(len(states), float(1 << (32 - PRECISION)))
        rows = max(_BLOCK // len(states), 1)
        cells = np.empty((rows, len(states)), np.intp)
        f, s = np.empty(cells.shape), np.empty(cells.shape)
        overflowed: list[F64] = []
        where: list[I64] = []
        for stop in range(steps, 0, -rows):
            start = max(stop - rows, 0)
            block = slice(0, stop - start)
            for k, section in enumerate(at_work):
                stream = len(section.cells) - back
                base = bases[k][section.models[stream]]
                part = cells[block, k * lanes : (k + 1) * lanes]
                np.add(section.cells[stream][start:stop], np.intp(base), out=part)
            frequencies.take(cells[block], out=f[block], mode="clip")
            starts.take(cells[block], out=s[block], mode="clip")
            rest = TOTAL - f[block]
            for frequency, others, first in zip(f[block][::-1], rest[::-1], s[block][::-1], strict=True):
                np.divide(states, frequency, quotients)
                np.greater_equal(quotients, most, large)
                (low,) = large.nonzero()
                if len(low):
                    full = states[low]
                    overflowed.append(full)
                    where.append(low)
                    full = np.floor(full * (1 / LOWEST))
                    states[low] = full
                    quotients[low] = full / frequency[low]
                np.floor(quotients, quotients)
                np.multiply(quotients, others, quotients)
                np.add(states, quotients, states)
                np.add(states, first, states)
        if where:
            taken = np.concatenate(overflowed[::-1]).astype(np.int64).astype("<u2")
            number = np.concatenate(where[::-1]) // lanes
            for k in range(len(at_work)):
                words[k].append(taken[number == k].tobytes())
    coded: dict[int, tuple[NDArray[np.uint32], bytes]] = {}
    for k, i in enumerate(ranked):
        coded[i] = (all_states[k * lanes : (k + 1) * lanes].astype(np.uint32), b"".join(reversed(words[k])))
    return [coded[i] for i in range(len(sections))]


def _tables(sections: Sequence[Tokens]) -> tuple[list[list[int]], F64, F64]:
    """Frequencies and starts of all cells of all sections' models, and where those of each model begin."""
    bases: list[list[int]] = []
    frequencies: list[F64] = []
    starts: list[F64] = []
    size = 0
    for section in sections:
        bases.append([])
        for model in section.frequencies:
            bases[-1].append(size)
            # With all of the frequency and nothing before it, a lane without a token stays as it is.
            frequencies.append(np.append(model.ravel(), TOTAL).astype(np.float64))
            starts.append(np.append((np.cumsum(model, axis=1) - model).ravel(), 0).astype(np.float64))
            size += len(starts[-1])
    return bases, np.concatenate(frequencies), np.concatenate(starts)


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
