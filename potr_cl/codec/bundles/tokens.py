"""Integers as tokens of a small alphabet with some extra bits, and how large a token's integers are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
