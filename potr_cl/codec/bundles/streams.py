"""Which streams a section of coder BUNDLES has, and what the contexts of each are made of.

A token has a *size*, which says how large what it stands for is. The context of a token is told by a weighted sum of
*terms*: sizes that are known already of the same splat, or numbers made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.tokens import SIZES, token_floors
from potr_cl.codec.sections import SH, Property
from potr_cl.codec.steps.rule import CLASSES

I32 = NDArray[np.int32]

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
