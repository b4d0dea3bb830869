"""Which streams a section of coder BUNDLES has, what the contexts of each are made of, and what their integers become:
tokens of a small alphabet with some extra bits, interleaved range coded (rANS, Duda 2013).

A token has a *size*, which says how large what it stands for is. The context of a token is told by a weighted sum of
*terms*: sizes that are known already of the same splat, or numbers made of them. Every lane of the range coder has a
state of its own, and lanes share a stream of 16-bit words. docs/format.md, "Bundles", is the normative description.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.sections import SH, Property
from potr_cl.codec.steps.rule import CLASSES
from potr_cl.errors import DataError

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

#: Integers of at most this many bits are tokens by themselves.
_DIRECT_BITS = 7
DIRECT = 1 << _DIRECT_BITS
#: Integers have at most this many bits, once they are mapped to unsigned ones.
MOST_BITS = 38
#: Tokens there are: 4 for each power of two from the direct ones up.
ALPHABET = DIRECT + 4 * (MOST_BITS - _DIRECT_BITS)


def token_floors() -> I64:
    """(ALPHABET,) the least of the integers, mapped to unsigned ones, that each token stands for."""
    token = np.arange(ALPHABET)
    above = np.maximum(token - DIRECT, 0)
    return np.where(token < DIRECT, token, (4 + above % 4) << (_DIRECT_BITS - 2 + above // 4))


def _size_table(signed: bool) -> I32:
    mapped = token_floors()
    magnitude = (mapped + 1) // 2 if signed else mapped
    sizes: I32 = np.floor(16 * np.log2(1.0 + magnitude) + 0.5).astype(np.int32)
    return sizes


#: By whether integers are signed: (ALPHABET,) 16 log2(1 + magnitude) of the least integer of each token, rounded.
SIZES = {signed: _size_table(signed) for signed in (False, True)}


def tokens_of(mapped: NDArray[Any]) -> U8:
    """Tokens, uint8 of the same shape, of integers of any shape, mapped to unsigned, below 2^38."""
    tokens = mapped.astype(np.uint8)
    large = np.flatnonzero(mapped >= DIRECT)
    if len(large):
        u = mapped.ravel()[large].astype(np.int64)
        exponent = np.frexp(u.astype(np.float64))[1] - 1  # exact below 2^53
        leading = u >> (exponent - 2)  # 4 to 7
        tokens.ravel()[large] = DIRECT + 4 * (exponent - _DIRECT_BITS) + leading - 4
    return tokens


def largest_integer(token: int) -> int:
    """The largest of the integers, mapped to unsigned ones, that a token stands for."""
    if token < DIRECT:
        return token
    above = token - DIRECT
    return ((5 + above % 4) << (_DIRECT_BITS - 2 + above // 4)) - 1


def extra_bits(tokens: NDArray[np.integer]) -> I64:
    """How many extra bits each of some tokens has."""
    wide = tokens.astype(np.int64)
    return np.where(wide < DIRECT, 0, _DIRECT_BITS - 2 + (wide - DIRECT) // 4)


#: The frequencies of a context add up to two to the power of this.
PRECISION = 12
TOTAL = 1 << PRECISION
#: A state is at or above this between steps, and below it times 2^16; coding starts and decoding ends with it.
LOWEST = 1 << 16
#: What divides the sums that tell contexts, as a power of two.
CONTEXT_SHIFT = 8


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


#: Size of a mask for each coefficient in it, and of a pattern with chroma.
COUNT_SIZE, CHROMA_SIZE = 32, 128
#: What a class of steps adds to the term that it is.
STEP_SIZE = 4
#: Patterns: bits 0, 1, 2 for Y, Co, Cg.
PATTERNS = 8

_CHANNELS = range(3)
_OPACITY = ("opacity",)
_STEP = ("step",)
_SCALES = tuple(f"scale {a}" for a in _CHANNELS)
_DIFFERENCES = tuple(f"difference {a}" for a in _CHANNELS)
_ROTATIONS = tuple(f"rotation {a}" for a in _CHANNELS)
_DC = tuple(f"dc {c}" for c in _CHANNELS)
_SUMS = tuple(f"sum {c}" for c in _CHANNELS)
_VALUES = tuple(f"value {c}" for c in _CHANNELS)


@dataclass(frozen=True, eq=False)
class Stream:
    """What is known of a stream before anything of a file is.

    Attributes:
        name: also that of the term that its sizes are.
        terms: of its contexts, in the order of their weights.
        sizes: (tokens,) int32 by token.
        coefficients: 0 for a stream of an item a splat; else it has items for coefficients of a splat, and its contexts
            a bias for each of so many.
    """

    name: str
    terms: tuple[str, ...]
    sizes: I32
    coefficients: int = 0

    @property
    def most_tokens(self) -> int:
        return len(self.sizes)

    @property
    def weights(self) -> int:
        """Numbers that tell its contexts: of the terms, of the recent sizes, a constant, biases."""
        return len(self.terms) + 2 + self.coefficients


def _nonzero_sizes() -> I32:
    """Of tokens of integers that are not 0: of what zig-zag makes of them, less 1."""
    magnitudes = (token_floors() + 2) // 2
    sizes: I32 = np.floor(16 * np.log2(1.0 + magnitudes) + 0.5).astype(np.int32)
    return sizes


_NONZERO_SIZES = _nonzero_sizes()


@lru_cache
def streams_of(prop: Property) -> tuple[Stream, ...]:
    """The streams of a section, in the order of decoding."""
    if prop == Property.OPACITY:
        return (Stream("opacity", (), SIZES[False]),)
    if prop == Property.SCALE:
        return tuple(Stream(name, _SCALES[:a], SIZES[False]) for a, name in enumerate(_SCALES))
    if prop == Property.ROTATION:
        known = _SCALES + _DIFFERENCES
        return tuple(Stream(name, known + _ROTATIONS[:a], SIZES[True]) for a, name in enumerate(_ROTATIONS))
    if prop is Property.SH0:
        return tuple(Stream(name, _OPACITY + _SCALES + _STEP + _DC[:c], SIZES[True]) for c, name in enumerate(_DC))
    first, end = band(prop)
    number = end - first
    masks = np.array([COUNT_SIZE * mask.bit_count() for mask in range(1 << number)], np.int32)
    patterns = np.where(np.arange(PATTERNS) > 1, CHROMA_SIZE, 0).astype(np.int32)
    splat, item = _OPACITY + _SCALES + _STEP + _DC + _SUMS, (*_SUMS, "mask", *_STEP)
    return (
        Stream("mask", splat, masks),
        Stream("pattern", item, patterns, number),
        *(Stream(name, (*item, "pattern", *_VALUES[:c]), _NONZERO_SIZES, number) for c, name in enumerate(_VALUES)),
    )


def band(prop: Property) -> tuple[int, int]:
    """The first SH coefficient of a section, and the one after the last."""
    degree = SH.index(prop)
    return degree**2, (degree + 1) ** 2


def step_terms(classes: NDArray[np.int8]) -> NDArray[np.int64]:
    """The terms, (N,) int64, that splats' classes of the steps of DC stand for: (N,) int8, -32 to 31."""
    return STEP_SIZE * (classes.astype(np.int64) + CLASSES)


def differences(scales: Sequence[NDArray[np.signedinteger]]) -> list[NDArray[np.signedinteger]]:
    """How far apart the sizes of a splat's scales, (N,) an axis, are: of axes 0 and 1, 1 and 2, 0 and 2, (N,) each."""
    a, b, c = scales
    return [np.abs(a - b), np.abs(b - c), np.abs(a - c)]
