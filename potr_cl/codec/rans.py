"""Interleaved range coding (rANS, Duda 2013) of tokens with static frequencies, many lanes at a time.

Every lane has a state of its own; all lanes take one token in each step and share one stream of 16-bit words. A step is
a handful of array operations over the lanes, so plain numpy decodes tens of millions of tokens a second, and a GPU
could give each lane a work-item. All arithmetic is exact, on integers, also where floats hold them: the bytes are the
same on every machine.
docs/format.md, "Context coder", is the normative description.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.functions import Functions
from potr_cl.codec.native.library import native
from potr_cl.errors import DataError

#: The frequencies of a context add up to two to the power of this.
PRECISION = 12
TOTAL = 1 << PRECISION
#: A state is at or above this between steps, and below it times 2^16; coding starts and decoding ends with it.
LOWEST = 1 << 16
#: How a decoder's trails fade, and what divides the sums that tell contexts.
TRAIL_SHIFT, TRAIL_FACTOR = 2, 3
CONTEXT_SHIFT = 8
#: Tokens that an encoder and a decoder prepare at a time: few enough for what there is to each to stay in a cache.
_BLOCK = 1 << 15
_DECODED = 1 << 16

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


@dataclass(frozen=True)
class Tokens:
    """What is coded into one stream of words, for :func:`encode`.

    Attributes:
        cells: one array a stream, in the order of decoding: (T, L) uint16, each lane's token in each step as class · A
            + token, or classes · A where a lane has none.
        models: which of those below each stream has.
        frequencies: (contexts, A) each, every row adding up to :data:`TOTAL`.
        contexts: (classes,) each, the context of each class.
    """

    cells: Sequence[U16]
    models: Sequence[int]
    frequencies: Sequence[I64]
    contexts: Sequence[NDArray[np.integer]]


def encode(sections: Sequence[Tokens]) -> list[tuple[NDArray[np.uint32], bytes]]:
    """Code some sections side by side: each comes out as if it were alone, but small ones share numpy's calls.

    Args:
        sections: not none; with the same T and L.

    Returns:
        The (L,) states and the words of each, as a :class:`Decoder` takes them.
    """
    functions = native()
    if functions is not None:
        return [_encode_natively(functions, section) for section in sections]
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


def _encode_natively(functions: Functions, section: Tokens) -> tuple[NDArray[np.uint32], bytes]:
    """:func:`encode` of one section by the native path."""
    bases, frequencies, starts = _tables([section])
    intervals = (frequencies + starts * (1 << 16)).astype(np.uint32)
    ends = [*bases[0][1:], len(intervals)]
    states = np.full(section.cells[0].shape[1], LOWEST, np.uint32)
    words = []
    for cells, model in zip(reversed(section.cells), reversed(section.models), strict=True):
        words.append(
            functions.encode_stream(np.ascontiguousarray(cells), intervals[bases[0][model] : ends[model]], states)
        )
    return states, b"".join(part.astype("<u2", copy=False).tobytes() for part in reversed(words))


def _tables(sections: Sequence[Tokens]) -> tuple[list[list[int]], F64, F64]:
    """Frequencies and starts of all cells of all sections' models, and where those of each model begin."""
    bases: list[list[int]] = []
    frequencies: list[F64] = []
    starts: list[F64] = []
    size = 0
    for section in sections:
        bases.append([])
        for model, contexts in zip(section.frequencies, section.contexts, strict=True):
            bases[-1].append(size)
            before = np.cumsum(model, axis=1) - model
            # With all of the frequency and nothing before it, a lane without a token stays as it is.
            for parts, values, idle in ((frequencies, model, TOTAL), (starts, before, 0)):
                parts.append(np.append(values.astype(np.float64)[contexts].ravel(), idle))
            size += len(starts[-1])
    return bases, np.concatenate(frequencies), np.concatenate(starts)


#: Where an entry of a table has its parts: the token's frequency, the trail's factor; from the 13th bit on of each half
#: the slot's place within the token and what the token adds to the trail: where a pair of state and trail needs them.
_FACTORS = 2 * TOTAL - 1 | TRAIL_FACTOR << 32
_ADDENDS_AT = 13


@dataclass(frozen=True)
class Table:
    """A model, for decoding: what a slot (context · :data:`TOTAL` + the lowest bits of a state) stands for.

    Attributes:
        entries: (contexts · TOTAL,) what it does to a pair of state and trail.
        tokens: its token.
    """

    entries: I64
    tokens: U8

    @staticmethod
    def of(frequencies: I64, worth: I64) -> Table:
        """From frequencies (contexts, A), every row adding up to :data:`TOTAL`, and the tokens' worth, below 2^19."""
        contexts, alphabet = frequencies.shape
        flat = frequencies.ravel()
        tokens = np.tile(np.arange(alphabet, dtype=np.uint8), contexts)
        starts = np.cumsum(flat) - flat
        places = np.arange(contexts * TOTAL) - np.repeat(starts, flat)
        entries: I64 = np.repeat(flat | TRAIL_FACTOR << 32 | worth[tokens] << 32 + _ADDENDS_AT, flat)
        entries |= places << _ADDENDS_AT
        return Table(entries.astype("<i8", copy=False), np.repeat(tokens, flat))


class Decoder:
    """Gives tokens back, stream by stream.

    Beside its state every lane has a *trail*, a running mean of what its last tokens were worth, which may tell the
    next one's context: with each token, trail becomes TRAIL_FACTOR · ⌊trail / 2^TRAIL_SHIFT⌋ + the token's worth. That
    is what happens to the state, so both take part in the same array operations.

    Args:
        states: (L,) as the encoder left them.
        words: little-endian 16-bit words.
        what: for messages.
    """

    def __init__(self, states: NDArray[np.integer], words: bytes | memoryview, what: str) -> None:
        lanes = len(states)
        # Pairs of state and trail as 32-bit numbers; also taken as one 64-bit number, and as 16-bit ones.
        self._pairs = np.zeros(2 * lanes, "<u4")
        self._pairs[0::2] = states
        self._words = np.frombuffer(words, "<u2")
        self._read = 0
        self._what = what
        # numpy is faster with arrays of constants than with constants.
        self._shifts = np.tile(np.array([PRECISION, TRAIL_SHIFT], "<u4"), lanes)
        self._down = np.full(2 * lanes, _ADDENDS_AT, "<u4")
        constants = [32, CONTEXT_SHIFT, TOTAL - 1, 0xFFFF0000, 0, _FACTORS]
        self._constants = np.repeat(np.array(constants, np.int64)[:, None], lanes, axis=1)

    def stream(
        self, table: Table, contexts: I64, known: Callable[[slice], I64], weight: int, trail: int, lanes: I64
    ) -> U8:
        """Decode a stream of a token a lane and step.

        Args:
            table: of the model.
            contexts: context · :data:`TOTAL` of each value of (known + weight · trail) >> CONTEXT_SHIFT; values below 0
                and beyond the last are taken as these.
            known: gives it for all lanes in some steps; asked for step after step.
            weight: of the trail.
            trail: of every lane at the start.
            lanes: (T,) lanes that have a token in each step, the first ones; the others get token 0. Never grows.

        Returns:
            (T, L) tokens.

        Raises:
            DataError: no words are left.
        """
        self._pairs[1::2] = trail
        tokens = np.zeros((len(lanes), len(self._pairs) // 2), np.uint8)
        # Where the number of lanes changes, and before too much to keep in a cache.
        rows = max(_DECODED // tokens.shape[1], 1)
        ends = np.flatnonzero(np.diff(lanes, append=0)) + 1
        start = 0
        for end in ends.tolist():
            count = int(lanes[start])
            for first in range(start, end, rows):
                steps = slice(first, min(first + rows, end))
                if count:
                    tokens[steps, :count] = self._steps(table, contexts, known(steps)[:, :count], weight)
            start = end
        return tokens

    def _steps(self, table: Table, contexts: I64, known: I64, weight: int) -> U8:
        """The next tokens of the first lanes, as many steps and lanes as there are of ``known``."""
        slots = np.empty(known.shape, np.int64)
        lanes = known.shape[1]
        pairs, shifts = self._pairs[: 2 * lanes], self._shifts[: 2 * lanes]
        both = pairs.view("<i8")
        low, high = pairs.view("<u2")[0::4], pairs.view("<u2")[1::4]
        halves, eights, low_bits, high_bits, none, in_factors = self._constants[:, :lanes]
        down = self._down[: 2 * lanes]
        weights = np.full(lanes, weight, np.int64)
        size, context, entry, factor = (np.empty(lanes, "<i8") for _ in range(4))
        few = np.empty(lanes, bool)
        addends, factors = entry.view("<u4"), factor.view("<u4")
        find, look_up = contexts.take, table.entries.take
        shift, multiply, add, mask, equal = np.right_shift, np.multiply, np.add, np.bitwise_and, np.equal
        words, read = self._words, self._read
        # Little is done in a step, so that what numpy takes to be called is most of the time: no call too many.
        for base, slot in zip(known, slots, strict=True):
            shift(both, halves, size)
            multiply(size, weights, size)
            add(size, base, size)
            shift(size, eights, size)
            find(size, None, context, "clip")
            mask(both, low_bits, slot)
            add(slot, context, slot)
            look_up(slot, None, entry, "wrap")  # faster than the others, and there is nothing to wrap
            mask(entry, in_factors, factor)
            shift(addends, down, addends)
            shift(pairs, shifts, pairs)
            multiply(pairs, factors, pairs)
            add(pairs, addends, pairs)
            mask(both, high_bits, size)
            equal(size, none, few)
            (at,) = few.nonzero()
            if count := len(at):
                taken = words[read : read + count]
                read += count
                if len(taken) < count:
                    raise no_words_left(self._what)
                # States below 2^16 have nothing in their higher half: it takes the lower one, which takes a word.
                high[at] = low[at]
                low[at] = taken
        self._read = read
        return table.tokens.take(slots)

    def finish(self) -> None:
        """Check that all words were taken and every lane is back where its encoder began.

        Raises:
            DataError: they are not.
        """
        check_end(self._read == len(self._words), self._pairs[0::2], self._what)


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
