"""The decoder of sections: :class:`Reader`, from a section's stored bytes, which it does not trust, to its streams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import rans
from potr_cl.codec.context.lanes import Lanes, from_residuals
from potr_cl.codec.context.model import CHANNELS, HEAD, Model, Sizes, read_description
from potr_cl.codec.context.tokens import ALPHABET, SIZES, Bits, bits_beside, detokenise, largest_integer
from potr_cl.codec.native.functions import Functions
from potr_cl.codec.native.library import native
from potr_cl.errors import DataError

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

#: What a decoder's trail is while there are no recent sizes, and what a token adds to it.
_NO_TRAIL = rans.TRAIL_FACTOR
_WORTH = {signed: rans.TRAIL_FACTOR * (2 * sizes.astype(np.int64) + 1) for signed, sizes in SIZES.items()}


class Reader:
    """A section's streams, one after another.

    Args:
        stored: the section's bytes; nothing in them is trusted.
        splats: n.
        streams: number of streams.
        signed, predicted: as of :class:`potr_cl.codec.context.encoder.Streams`.
        history: sizes of the chain's sections before, to which this one's are added; None if it is the first.
        what: for messages.

    Raises:
        DataError: damaged.
    """

    def __init__(
        self,
        stored: memoryview,
        splats: int,
        streams: int,
        signed: bool,
        predicted: bool,
        history: Sizes | None,
        what: str,
    ) -> None:
        self._lanes = Lanes(splats)
        self._streams = streams
        self._signed = signed
        self._predicted = predicted
        self._history = history or Sizes(self._lanes)
        self._what = what
        states_bytes = 4 * self._lanes.number
        if len(stored) < HEAD.size:
            raise self._damaged("ends too early")
        described, beside = HEAD.unpack_from(stored)
        if HEAD.size + described + beside + states_bytes > len(stored):
            raise self._damaged("ends too early")
        start = HEAD.size + described
        weights, models = read_description(stored[HEAD.size : start], streams, what)
        self._beside = np.frombuffer(stored[start : start + beside], np.uint8)
        self._bits_read = 0
        start += beside
        states = np.frombuffer(stored[start : start + states_bytes], "<u4")
        if (states < rans.LOWEST).any():
            raise self._damaged("holds an impossible state")
        start += states_bytes
        if (len(stored) - start) % 2:
            raise self._damaged("ends within a word")
        words = np.frombuffer(stored[start:], np.uint8)
        functions = native()
        self._functions = functions
        self._coder: _NumpyCoder | _NativeCoder
        if functions is None:
            self._coder = _NumpyCoder(weights, models, signed, self._lanes, states, words, what)
        else:
            self._coder = _NativeCoder(functions, weights, models, signed, self._lanes, states, words, what)

    def _damaged(self, how: str) -> DataError:
        return DataError(f"section '{self._what}' {how}")

    def __iter__(self) -> Iterator[Stream]:
        """Yield each stream.

        Raises:
            DataError: damaged.
        """
        all_bits = 8 * len(self._beside)
        for s in range(self._streams):
            tokens = self._coder.stream(s, self._history)
            self._history.added()
            count, largest = bits_beside(tokens) if self._functions is None else self._functions.bits_beside(tokens)
            first = self._bits_read
            self._bits_read += count
            if self._bits_read > all_bits:
                raise self._damaged("ends too early")
            yield Stream(self._lanes, tokens, largest, self._beside, first, count, self._signed, self._predicted)
        self._coder.finish()
        if all_bits - self._bits_read >= 8 or _bits(self._beside, self._bits_read, all_bits).any():
            raise self._damaged("holds more bits than its integers ask for")


class _NumpyCoder:
    """The tokens of a section's streams, by NumPy."""

    def __init__(
        self,
        weights: I32,
        models: Sequence[Model],
        signed: bool,
        lanes: Lanes,
        states: NDArray[np.uint32],
        words: U8,
        what: str,
    ) -> None:
        self._weights, self._signed, self._counts = weights, signed, lanes.counts
        self._tables = [_table(model, signed) for model in models]
        self._rans = rans.Decoder(states, words.data, what)

    def stream(self, s: int, history: Sizes) -> U8:
        """(steps, lanes) tokens of the next stream, number ``s``, whose sizes go into ``history.next``.

        Raises:
            DataError: no words are left.
        """
        classes, table = self._tables[s % CHANNELS]
        known = history.known()
        weights = self._weights[s]
        # Channels of the same coefficient that come later are not known yet: their weights do not count.
        expected = partial(_expected, known, weights[: len(known)], int(weights[-2]), int(weights[-1]))
        tokens = self._rans.stream(table, classes, expected, int(weights[-2]), _NO_TRAIL, self._counts)
        SIZES[self._signed].take(tokens, out=history.next, mode="clip")
        return tokens

    def finish(self) -> None:
        """Check that all ends as it must.

        Raises:
            DataError: it does not.
        """
        self._rans.finish()


class _NativeCoder:
    """The same by the native path."""

    def __init__(
        self,
        functions: Functions,
        weights: I32,
        models: Sequence[Model],
        signed: bool,
        lanes: Lanes,
        states: NDArray[np.uint32],
        words: U8,
        what: str,
    ) -> None:
        self._functions, self._weights, self._lanes, self._what = functions, weights, lanes, what
        self._tables = [(functions.context_table(model.frequencies), model.classes) for model in models]
        self._sizes = np.zeros(256, np.int16)
        self._sizes[:ALPHABET] = SIZES[signed]
        self._states = states.astype(np.uint32)
        self._words, self._read = words, 0

    def stream(self, s: int, history: Sizes) -> U8:
        """As :meth:`_NumpyCoder.stream`."""
        entries, classes = self._tables[s % CHANNELS]
        tokens = np.empty((self._lanes.steps, self._lanes.number), np.uint8)
        read = self._functions.context_stream(
            self._words,
            self._read,
            self._states,
            entries,
            classes,
            self._sizes,
            history.known(),
            self._weights[s],
            self._lanes.counts,
            tokens,
            history.next,
        )
        if read is None:
            raise rans.no_words_left(self._what)
        self._read = read
        return tokens

    def finish(self) -> None:
        """As :meth:`_NumpyCoder.finish`."""
        rans.check_end(2 * self._read == len(self._words), self._states, self._what)


def _table(model: Model, signed: bool) -> tuple[I64, rans.Table]:
    """What :meth:`potr_cl.codec.rans.Decoder.stream` takes of a model: contexts and table.

    Three times an expected size is looked up, as :func:`_expected` tells, and so each has three places.
    """
    contexts = np.repeat(model.classes.astype(np.int64) * rans.TOTAL, rans.TRAIL_FACTOR)
    return contexts, rans.Table.of(model.frequencies, _WORTH[signed])


def _expected(known: Sequence[I32], weights: I32, recent: int, constant: int, steps: slice) -> I64:
    """What :meth:`potr_cl.codec.rans.Decoder.stream` adds to the recent sizes' part of a context.

    With ρ the recent sizes, its trail is 3 ρ + 3 (⌊trail / 4⌋ is ρ − ⌊ρ / 4⌋), and so all is three times as much: 3 ·
    (the weighted sum of what is known − the weight of ρ).
    """
    total = np.full(known[0][steps].shape, constant - recent, np.int32)
    product = np.empty_like(total)
    for term, weight in zip(known, weights, strict=True):
        if weight:
            np.multiply(term[steps], weight, product)
            np.add(total, product, total)
    return np.multiply(total, rans.TRAIL_FACTOR, dtype=np.int64)


@dataclass(frozen=True)
class Stream:
    """A stream whose integers need no other's any more: that can be left to another thread.

    Attributes:
        tokens: (steps, lanes).
        largest: the largest token.
        beside: bytes of the section's bits beside tokens.
        first, bits: number of the first bit that is this stream's, and how many are.
    """

    lanes: Lanes
    tokens: U8
    largest: int
    beside: U8
    first: int
    bits: int
    signed: bool
    predicted: bool

    @property
    def values(self) -> NDArray[np.integer]:
        """(n,) integers of any type."""
        return self.part(0, self.lanes.splats)

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        """Those from one splat to another."""
        values = self.joined[start:stop]
        if self.signed and values.dtype == np.uint8:
            return ((values >> 1) ^ (0 - (values & 1)).astype(np.uint8)).view(np.int8)
        return values

    @cached_property
    def joined(self) -> NDArray[np.integer]:
        """(n,) uint8, mapped to unsigned, where all integers are that small; else int32 or int64."""
        functions = native()
        tokens = self.tokens
        if not (self.bits or self.predicted):
            return self.lanes.join(tokens) if functions is None else functions.join_lanes(tokens)[: self.lanes.splats]
        if functions is not None:
            # The largest in magnitude of all that are mapped to what this token stands for.
            most = largest_integer(self.largest) // (2 if self.signed else 1) + 1
            found = functions.integers_of_tokens(tokens, self.beside, self.first, most, self.signed, self.predicted)
            return found[: self.lanes.splats]
        bits = _bits(self.beside, self.first, self.first + self.bits)
        values = detokenise(tokens, bits, self.signed)
        return self.lanes.join(from_residuals(values) if self.predicted else values)


def _bits(packed: U8, start: int, stop: int) -> Bits:
    """Bits from one number to another of packed ones."""
    first = start // 8
    return np.unpackbits(packed[first : (stop + 7) // 8], bitorder="little").view(bool)[
        start - 8 * first : stop - 8 * first
    ]
