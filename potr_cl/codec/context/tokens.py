"""Integers as tokens of a small alphabet with some bits beside, and how large a token's integers are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Bits = NDArray[np.bool_]

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


def tokenise(values: NDArray[np.integer], signed: bool) -> tuple[U8, Bits] | None:
    """Tokens of integers, and the bits beside them; None if one of them is too large.

    Args:
        values: of any shape, at least one; not negative if not ``signed``.
        signed: whether they may be negative.

    Returns:
        Tokens in the shape of the values; and bits: the lowest of all tokens that have one, then the second lowest of
        all that have two, and so on.
    """
    # 0, −1, 1, −2, … become 0, 1, 2, 3, …
    mapped = (values << 1) ^ (values >> (8 * values.itemsize - 1)) if signed else values
    mapped = mapped.view(f"u{values.itemsize}")
    largest = int(mapped.max())
    if largest >> MOST_BITS:
        return None
    tokens = tokens_of(mapped)
    if largest < DIRECT:
        return tokens, np.zeros(0, bool)
    large = np.flatnonzero(tokens >= DIRECT)
    u = mapped.ravel()[large].astype(np.int64)
    extra = extra_bits(tokens.ravel()[large])
    return tokens, np.concatenate([(u[extra > b] >> b) & 1 for b in range(int(extra.max()))]).astype(bool)


def detokenise(tokens: U8, bits: Bits, signed: bool) -> I64:
    """The integers of tokens and the bits beside them, in the tokens' shape: undoes :func:`tokenise`."""
    mapped = tokens.astype(np.int64)
    where = np.flatnonzero(tokens >= DIRECT)
    large = tokens.ravel()[where]
    extra = extra_bits(large)
    u = (4 + (large - DIRECT) % np.int64(4)) << extra
    read = 0
    for b in range(int(extra.max(initial=0))):
        has = extra > b
        need = int(np.count_nonzero(has))
        u[has] |= bits[read : read + need].astype(np.int64) << b
        read += need
    mapped.ravel()[where] = u
    return (mapped >> 1) ^ -(mapped & 1) if signed else mapped


def bits_beside(tokens: U8) -> tuple[int, int]:
    """How many bits stand beside some tokens, at least one, and the largest token."""
    largest = int(tokens.max())
    return (int(extra_bits(tokens[tokens >= DIRECT]).sum()) if largest >= DIRECT else 0), largest


def largest_integer(token: int) -> int:
    """The largest of the integers, mapped to unsigned ones, that a token stands for."""
    if token < DIRECT:
        return token
    above = token - DIRECT
    return ((5 + above % 4) << (_DIRECT_BITS - 2 + above // 4)) - 1


def extra_bits(tokens: NDArray[np.integer]) -> I64:
    """How many bits stand beside each of some tokens."""
    wide = tokens.astype(np.int64)
    return np.where(wide < DIRECT, 0, _DIRECT_BITS - 2 + (wide - DIRECT) // 4)
