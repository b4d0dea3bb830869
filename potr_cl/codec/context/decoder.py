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
from potr_cl.codec.context.tokens import SIZES, Bits, bits_beside, detokenise
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
        self._weights, models = read_description(stored[HEAD.size : start], streams, what)
        self._tables = [_table(model, signed) for model in models]
        bits = np.frombuffer(stored[start : start + beside], np.uint8)
        self._bits = np.unpackbits(bits, bitorder="little").view(bool)
        self._bits_read = 0
        start += beside
        states = np.frombuffer(stored[start : start + states_bytes], "<u4").astype(np.int64)
        if (states < rans.LOWEST).any():
            raise self._damaged("holds an impossible state")
        if (len(stored) - start - states_bytes) % 2:
            raise self._damaged("ends within a word")
        self._rans = rans.Decoder(states, stored[start + states_bytes :], what)

    def _damaged(self, how: str) -> DataError:
        return DataError(f"section '{self._what}' {how}")

    def __iter__(self) -> Iterator[Stream]:
        """Yield each stream.

        Raises:
            DataError: damaged.
        """
        lanes = self._lanes.counts
        for s in range(self._streams):
            classes, table = self._tables[s % CHANNELS]
            known = self._history.known()
            weights = self._weights[s]
            # Channels of the same coefficient that come later are not known yet: their weights do not count.
            expected = partial(_expected, known, weights[: len(known)], int(weights[-2]), int(weights[-1]))
            tokens = self._rans.stream(table, classes, expected, int(weights[-2]), _NO_TRAIL, lanes)
            self._history.add(SIZES[self._signed].take(tokens))
            end = self._bits_read + bits_beside(tokens)
            bits = self._bits[self._bits_read : end]
            if end > len(self._bits):
                raise self._damaged("ends too early")
            self._bits_read = end
            yield Stream(self._lanes, tokens, bits, self._signed, self._predicted)
        self._rans.finish()
        rest = self._bits[self._bits_read :]
        if len(rest) >= 8 or rest.any():
            raise self._damaged("holds more bits than its integers ask for")


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
        bits: beside the tokens.
    """

    lanes: Lanes
    tokens: U8
    bits: Bits
    signed: bool
    predicted: bool

    @property
    def values(self) -> NDArray[np.integer]:
        """(n,) integers of any type."""
        return self.part(0, self.lanes.splats)

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        """Those from one splat to another."""
        values = self._joined[start:stop]
        if self.signed and values.dtype == np.uint8:
            return ((values >> 1) ^ (0 - (values & 1)).astype(np.uint8)).view(np.int8)
        return values

    @cached_property
    def _joined(self) -> NDArray[np.integer]:
        """(n,) integers, mapped to unsigned ones as long as they are bytes."""
        tokens = self.tokens
        if not (len(self.bits) or self.predicted):
            return self.lanes.join(tokens)
        values = detokenise(tokens, self.bits, self.signed)
        return self.lanes.join(from_residuals(values) if self.predicted else values)
