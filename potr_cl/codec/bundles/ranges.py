"""Range coding (rANS, Duda 2013) of the lanes of bundles, each bundle with words of its own, by NumPy.

As in :mod:`potr_cl.codec.rans` every lane has a state, and the lanes of a bundle share a sequence of 16-bit words. Here
the bundles are coded side by side, each from its own sequence: where a lane needs a word, that is the next of its
bundle, lane after lane. docs/format.md, "Bundles", is the normative description.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Fitted
from potr_cl.codec.bundles.layout import LANES, Layout
from potr_cl.codec.context.model import LARGEST_SIZE
from potr_cl.codec.context.tokens import DIRECT, extra_bits
from potr_cl.codec.rans import CONTEXT_SHIFT, LOWEST, PRECISION, TOTAL, no_words_left

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

#: Extra bits that a state gives at a time.
CHUNK = 12
_FREQUENCY_BITS = PRECISION + 1


class Words:
    """The words of a section, which are taken from its beginning, bundle by bundle.

    Args:
        words: of all bundles, one after another.
        counts: (bundles,) of each.
        what: the section, for messages.
    """

    def __init__(self, words: U16, counts: I64, what: str) -> None:
        self._words, self._what = words, what
        self._ends = np.cumsum(counts)
        self._next = self._ends - counts

    def renormalise(self, states: I64) -> None:
        """Give a word to every state (bundles · LANES,) that needs one.

        Raises:
            DataError: no words are left.
        """
        (at,) = np.nonzero(states < LOWEST)
        if not len(at):
            return
        bundles = at // LANES
        counts = np.bincount(bundles, minlength=len(self._ends))
        firsts = np.cumsum(counts) - counts
        taken = np.arange(len(at)) + (self._next - firsts)[bundles]
        self._next += counts
        if (self._next > self._ends).any():
            raise no_words_left(self._what)
        states[at] = states[at] << 16 | self._words[taken]

    @property
    def all_taken(self) -> bool:
        return bool((self._next == self._ends).all())


def decode_stream(layout: Layout, base: I64, fitted: Fitted, states: I64, words: Words) -> tuple[U8, I64]:
    """Decode a stream.

    Args:
        layout: of its items.
        base: (items,) weighted sums of terms, with constant and bias.
        fitted: what the section says of the stream.
        states: (columns,), brought up to date.
        words: of the section.

    Returns:
        (items,) tokens, and the integers that they stand for, mapped to unsigned.

    Raises:
        DataError: no words are left.
    """
    contexts, tokens, entries = _tables(fitted)
    sizes = 2 * fitted.stream.sizes.astype(np.int64)
    found = np.zeros(layout.shape, np.uint8)
    extra = np.zeros(layout.shape, np.int64) if fitted.alphabet > DIRECT else None
    recent = np.zeros(layout.shape[1], np.int64)
    idle = layout.idle
    partly = set(np.flatnonzero(idle.any(axis=1)).tolist())
    for t, (expected, token) in enumerate(zip(layout.laid(base), found, strict=True)):
        expected += fitted.recent * recent
        expected >>= CONTEXT_SHIFT
        slot = contexts.take(expected, mode="clip")
        if t in partly:
            slot[idle[t]] = len(entries) - TOTAL
        slot += states & (TOTAL - 1)
        tokens.take(slot, out=token, mode="clip")
        entry = entries.take(slot)
        states[:] = (states >> PRECISION) * (entry & (2 * TOTAL - 1)) + (entry >> _FREQUENCY_BITS)
        words.renormalise(states)
        if extra is not None and (token >= DIRECT).any():
            _take_bits(token, states, words, extra[t])
        recent += sizes.take(token, mode="clip") - (recent >> 2)
    of_items = layout.taken(found)
    return of_items, _integers(of_items, None if extra is None else layout.taken(extra))


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


def _integers(tokens: U8, extra: I64 | None) -> I64:
    mapped = tokens.astype(np.int64)
    if extra is None:
        return mapped
    (large,) = np.nonzero(tokens >= DIRECT)
    some = tokens[large]
    mapped[large] = (4 + (some - np.int64(DIRECT)) % 4) << extra_bits(some) | extra[large]
    return mapped


def _tables(fitted: Fitted) -> tuple[I64, U8, I64]:
    """Where the context of each expected size begins, and of each slot: its token; frequency and place in one number.

    Behind the contexts stands one that leaves a state as it is.
    """
    frequencies = fitted.frequencies
    contexts, alphabet = frequencies.shape
    flat = frequencies.ravel()
    starts = np.cumsum(flat) - flat
    slots = np.arange(contexts * TOTAL)
    idle = TOTAL | np.arange(TOTAL) << _FREQUENCY_BITS
    entries = np.concatenate([np.repeat(flat, flat) | (slots - np.repeat(starts, flat)) << _FREQUENCY_BITS, idle])
    tokens = np.repeat(np.tile(np.arange(alphabet, dtype=np.uint8), contexts), flat)
    return (
        fitted.classes.astype(np.int64) * TOTAL,
        np.concatenate([tokens, np.zeros(TOTAL, np.uint8)]),
        entries,
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
    return (
        np.append(frequencies[fitted.classes].ravel(), TOTAL),
        np.append(starts[fitted.classes].ravel(), 0),
    )
