"""Range coding (rANS, Duda 2013) of the lanes of bundles, each bundle with words of its own, by NumPy.

The bundles are coded side by side, each from its own sequence: where a lane needs a word, that is the next of its
bundle, lane after lane. docs/format.md, "Bundles", is the normative description.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import LARGEST_SIZE, Fitted
from potr_cl.codec.bundles.layout import LANES, Layout
from potr_cl.codec.bundles.streams import (
    CONTEXT_SHIFT,
    DIRECT,
    LOWEST,
    PRECISION,
    TOTAL,
    extra_bits,
    largest_integer,
    no_words_left,
)

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

#: Extra bits that a state gives at a time.
CHUNK = 12
#: Where an entry of a decoder's table has the place within a token, and twice the token's size.
_FREQUENCY_BITS = PRECISION + 1
_SIZE_AT = _FREQUENCY_BITS + PRECISION
#: Numbers as arrays, which numpy takes in half the time.
_LOWEST, _WORD_BITS, _TWO = (np.array(number, np.int64) for number in (LOWEST, 16, 2))
_CONTEXT_SHIFT, _PRECISION, _PLACE = (np.array(number, np.int64) for number in (CONTEXT_SHIFT, PRECISION, TOTAL - 1))
_SIZE_SHIFT, _START_SHIFT, _FREQUENCY = (
    np.array(number, np.int64) for number in (_SIZE_AT, _FREQUENCY_BITS, 2 * TOTAL - 1)
)


class Words:
    """The words of a section, which are taken from its beginning, bundle by bundle.

    Args:
        words: of all bundles, one after another.
        counts: (bundles,) of each.
        what: the section, for messages.
    """

    def __init__(self, words: U16, counts: I64, what: str) -> None:
        # Behind a word that nobody takes, so that ranks from 1 on tell the next ones.
        self._words, self._what = np.concatenate([np.zeros(1, np.int64), words]), what
        self._ends = np.cumsum(counts)
        # All that a step needs is made once, views and numbers too: they take as long as a step's arithmetic.
        bundles = len(counts)
        self._low = np.empty(bundles * LANES, bool)
        self._low_of_lanes = self._low.reshape(bundles, LANES)
        # Before the lanes of a bundle stands where its next word is.
        self._ranks = np.empty((bundles, 1 + LANES), np.int64)
        self._ranks[:, 0] = self._ends - counts
        self._first, self._of_lanes, self._last = self._ranks[:, 0], self._ranks[:, 1:], self._ranks[:, -1]
        self._full, self._found = np.empty((2, bundles * LANES), np.int64)
        self._found_of_lanes = self._found.reshape(bundles, LANES)

    def renormalise(self, states: I64) -> None:
        """Give a word to every state (bundles · LANES,) that needs one; :meth:`check` tells if there were enough."""
        low, full = self._low, self._full
        np.less(states, _LOWEST, low)
        # Lane after lane of a bundle: the first that needs a word has the one behind those that are taken.
        np.copyto(self._of_lanes, self._low_of_lanes)
        np.add.accumulate(self._ranks, 1, None, self._ranks)
        self._words.take(self._of_lanes, None, self._found_of_lanes, "clip")
        np.left_shift(states, _WORD_BITS, full)
        np.bitwise_or(full, self._found, full)
        np.copyto(states, full, where=low)
        np.copyto(self._first, self._last)

    def check(self) -> None:
        """Check that there was a word whenever one was asked for. Raises DataError if there was not."""
        if (self._first > self._ends).any():
            raise no_words_left(self._what)

    @property
    def all_taken(self) -> bool:
        return bool((self._first == self._ends).all())


def decode_stream(
    layout: Layout, rows: I64, fitted: Fitted, states: I64, words: Words
) -> tuple[U8, NDArray[np.signedinteger]]:
    """Decode a stream.

    Args:
        layout: of its items.
        rows: (rows, columns) weighted sums of terms, with constant and bias; written over.
        fitted: what the section says of the stream.
        states: (columns,), brought up to date.
        words: of the section.

    Returns:
        (items,) tokens, and the integers that they stand for, mapped to unsigned.

    Raises:
        DataError: no words are left.
    """
    contexts, tokens, entries = _tables(fitted)
    extra = np.zeros(layout.shape, np.int64) if fitted.alphabet > DIRECT else None
    width = layout.shape[1]
    recent, a, b, entry = (np.zeros(width, np.int64) for _ in range(4))
    weight = np.array(fitted.recent)
    idle = layout.idle
    partly = set(np.flatnonzero(idle.any(axis=1)).tolist())
    resting = len(entries) - TOTAL
    # Tokens with bits beside them are at least as large.
    least = 2 * int(fitted.stream.sizes[DIRECT:].min(initial=LARGEST_SIZE))
    # Little is done in a step, so that what numpy takes to be called is most of the time: no call too many.
    multiply, add, subtract, shift, mask = np.multiply, np.add, np.subtract, np.right_shift, np.bitwise_and
    for t, slot in enumerate(rows):
        multiply(recent, weight, a)
        add(a, slot, a)
        shift(a, _CONTEXT_SHIFT, a)
        contexts.take(a, None, slot, "clip")
        if t in partly:
            slot[idle[t]] = resting
        mask(states, _PLACE, a)
        add(slot, a, slot)
        entries.take(slot, None, entry, "wrap")  # faster than the other modes, and there is nothing to wrap
        shift(recent, _TWO, a)
        subtract(recent, a, recent)
        shift(entry, _SIZE_SHIFT, a)
        add(recent, a, recent)
        large = extra is not None and a.max() >= least
        shift(states, _PRECISION, a)
        mask(entry, _FREQUENCY, b)
        multiply(a, b, a)
        shift(entry, _START_SHIFT, entry)
        mask(entry, _PLACE, entry)
        add(a, entry, states)
        words.renormalise(states)
        if large and extra is not None and (token := tokens.take(slot)).max() >= DIRECT:
            _take_bits(token, states, words, extra[t])
    words.check()
    of_items = layout.taken(tokens.take(rows))
    extras = None if extra is None else layout.taken(extra)
    return of_items, _integers(of_items, extras, integer_type(fitted.alphabet))


def _take_bits(tokens: U8, states: I64, words: Words, extra: I64) -> None:
    left = extra_bits(tokens)
    shift = 0
    while left.any():
        bits = np.minimum(left, CHUNK)
        extra |= (states & ((1 << bits) - 1)) << shift
        states >>= bits
        words.renormalise(states)
        left -= bits
        shift += CHUNK


def integer_type(alphabet: int) -> type[np.signedinteger]:
    """The narrowest type of the integers of so many tokens."""
    largest = largest_integer(alphabet - 1)
    return np.int16 if largest < 1 << 14 else np.int32 if largest < 1 << 30 else np.int64


def _integers(tokens: U8, extra: I64 | None, dtype: type[np.signedinteger]) -> NDArray[np.signedinteger]:
    mapped = tokens.astype(dtype)
    if extra is None:
        return mapped
    (large,) = np.nonzero(tokens >= DIRECT)
    some = tokens[large]
    mapped[large] = (4 + (some - np.int64(DIRECT)) % 4) << extra_bits(some) | extra[large]
    return mapped


def _tables(fitted: Fitted) -> tuple[I64, U8, I64]:
    """Where the context of each expected size begins, and of each slot: its token, and what it does in one number.

    That is its frequency, its place within the token, and twice the token's size. Behind the contexts stands one that
    leaves a state as it is.
    """
    frequencies = fitted.frequencies
    contexts, alphabet = frequencies.shape
    flat = frequencies.ravel()
    starts = np.cumsum(flat) - flat
    sizes = np.tile(2 * fitted.stream.sizes[:alphabet].astype(np.int64), contexts)
    entries = (np.arange(contexts * TOTAL) - np.repeat(starts, flat)) << _FREQUENCY_BITS
    entries |= np.repeat(flat | sizes << _SIZE_AT, flat)
    tokens = np.repeat(np.tile(np.arange(alphabet, dtype=np.uint8), contexts), flat)
    return (
        fitted.classes.astype(np.int64) * TOTAL,
        np.concatenate([tokens, np.zeros(TOTAL, np.uint8)]),
        np.concatenate([entries, TOTAL | np.arange(TOTAL) << _FREQUENCY_BITS]),
    )


# ----------------------------------------------------------------------------------------------- encoding


@dataclass(frozen=True)
class Tokens:
    """A stream's items, for :func:`encode_section`.

    Attributes:
        layout: of them.
        cells: (items,) expected size · alphabet + token.
        integers: (items,) what the tokens stand for, mapped to unsigned.
        fitted: what the section says of the stream.
    """

    layout: Layout
    cells: U16
    integers: I64
    fitted: Fitted


def encode_section(streams: list[Tokens], states: I64) -> tuple[I64, U16]:
    """Code the streams of a section, the last one first.

    Args:
        streams: at least one.
        states: (columns,) as what is decoded after the section leaves them; brought up to date.

    Returns:
        Words of each bundle, and the words.
    """
    bundles = len(streams[0].layout.counts)
    gone: list[tuple[I64, I64]] = []
    for stream in reversed(streams):
        frequencies, starts = intervals(stream.fitted)
        cells = np.full(stream.layout.shape, (LARGEST_SIZE + 1) * stream.fitted.alphabet, np.int64)
        cells.ravel()[stream.layout.places] = stream.cells
        large = stream.integers >= DIRECT
        rows = np.zeros(len(cells), bool)
        rows[stream.layout.places[large] // max(cells.shape[1], 1)] = True
        integers = stream.layout.laid(stream.integers) if large.any() else None
        for t in range(len(cells) - 1, -1, -1):
            if integers is not None and rows[t]:
                _give_bits(integers[t], cells[t] % stream.fitted.alphabet, states, gone)
            f = frequencies[cells[t]]
            _give_words(states >= f << (32 - PRECISION), states, gone)
            states += states // f * (TOTAL - f) + starts[cells[t]]
    if not gone:
        return np.zeros(bundles, np.int64), np.zeros(0, np.uint16)
    lanes = np.concatenate([at for at, _ in reversed(gone)]) // LANES
    order = np.argsort(lanes, kind="stable")
    words = np.concatenate([words for _, words in reversed(gone)])[order].astype(np.uint16)
    return np.bincount(lanes, minlength=bundles), words


def _give_bits(integers: I64, tokens: I64, states: I64, gone: list[tuple[I64, I64]]) -> None:
    number = np.where(integers >= DIRECT, extra_bits(tokens), 0)
    for shift in range((int(number.max()) - 1) // CHUNK * CHUNK, -1, -CHUNK):
        bits = np.clip(number - shift, 0, CHUNK)
        _give_words(states >= 1 << (32 - bits), states, gone)
        states <<= bits
        states |= integers >> shift & ((1 << bits) - 1)


def _give_words(full: NDArray[np.bool_], states: I64, gone: list[tuple[I64, I64]]) -> None:
    (at,) = np.nonzero(full)
    if len(at):
        gone.append((at, states[at] & 0xFFFF))
        states[at] >>= 16


def intervals(fitted: Fitted) -> tuple[I64, I64]:
    """Frequency of each cell, and the sum of those below; the last cell leaves a state as it is."""
    frequencies = fitted.frequencies
    starts = np.cumsum(frequencies, axis=1) - frequencies
    return (np.append(frequencies[fitted.classes].ravel(), TOTAL), np.append(starts[fitted.classes].ravel(), 0))
