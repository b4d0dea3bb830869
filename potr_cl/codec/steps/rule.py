"""The rule that gives each splat the steps of its colours: :class:`ColourSteps`.

The effect that an error of a splat's colour has on the pictures follows, roughly, from how large and how opaque the
splat is, and from where it lies: among the ones before and after it. So a few integers a scene, and one for each group
of splats that follow each other, tell what a splat's *weight* is; the scale factors of its colours are those of the
header times a power of it, in quarter octaves. All is computed with integers, from integers that are decoded already:
every decoder finds the same. docs/format.md, "Steps of colours", is the normative description.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.native.table import definition

I64 = NDArray[np.int64]
I8 = NDArray[np.int8]
F32 = NDArray[np.float32]
Levels = NDArray[np.integer]

#: Units of a weight, and of the logarithm of a scale, in an octave.
OCTAVE = 16
#: The weight's part of a logarithm is in units of one part in so many, as a power of two.
SHIFT = 8
#: Places at which the weight's part of the opacity is told, as a power of two of the spaces between them.
_SPACES_BITS = 4
KNOTS = (1 << _SPACES_BITS) + 1
#: What a group adds to a weight is in units of so many.
GROUP_UNIT = OCTAVE // 2
#: A class is (weight · power + offset) >> this.
CLASS_SHIFT = 6
#: Classes are from minus this to one less.
CLASSES = 32
#: Scales' levels beyond are taken for this.
_LARGEST_SCALE = (1 << 32) - 1
#: Levels whose logarithms are looked up.
_TABLE = 1 << 13
_MOST_SHIFT = 40

_HEAD = struct.Struct(f"<6B2h3h{KNOTS}h")
#: Bytes of a file's description beside one for each group.
MOST_BESIDE_GROUPS = _HEAD.size


@dataclass(frozen=True)
class ColourSteps:
    """What a file says of the steps of its colours.

    Attributes:
        group_bits: a group is 2 to the power of this splats that follow each other in the file.
        knot_shift: places of opacities are 2 to the power of this levels apart.
        first_knot: the first of them, in these units.
        powers: of the weight, for DC and for AC, in sixteenths: 8 stands for the root.
        offsets: added to the product of power and weight, for DC and for AC.
        scales: of the sorted logarithms of the scales, largest first.
        opacities: (KNOTS,) of opacities at the places.
        groups: (⌈N / 2^group_bits⌉,) int8, of each group.
    """

    group_bits: int
    knot_shift: int
    first_knot: int
    powers: tuple[int, int]
    offsets: tuple[int, int]
    scales: tuple[int, int, int]
    opacities: tuple[int, ...]
    groups: I8

    def to_bytes(self) -> bytes:
        """As they stand in a file."""
        head = _HEAD.pack(
            self.group_bits,
            self.knot_shift,
            self.first_knot,
            *self.powers,
            0,
            *self.offsets,
            *self.scales,
            *self.opacities,
        )
        return head + self.groups.astype(np.int8).tobytes()

    @staticmethod
    def from_bytes(raw: bytes, splats: int) -> ColourSteps:
        """Undo :meth:`to_bytes`; nothing in the bytes is trusted. Raises DataError if damaged."""
        impossible = DataError("section 'steps' describes impossible steps")
        if len(raw) < _HEAD.size:
            raise impossible
        group_bits, knot_shift, first_knot, dc, ac, zero, *rest = _HEAD.unpack_from(raw)
        if group_bits > _MOST_SHIFT or knot_shift > _MOST_SHIFT or zero:
            raise impossible
        if len(raw) - _HEAD.size != -(-splats >> group_bits):
            raise impossible
        return ColourSteps(
            group_bits,
            knot_shift,
            first_knot,
            (dc, ac),
            (rest[0], rest[1]),
            (rest[2], rest[3], rest[4]),
            tuple(rest[5:]),
            np.frombuffer(raw, np.int8, offset=_HEAD.size),
        )

    def weights(self, scales: Sequence[Levels], opacities: Levels, start: int = 0) -> I64:
        """(n,) logarithm of the weight of some splats that follow each other, in sixteenths of an octave.

        Args:
            scales: (n,) levels of the scales, >= 0, of each axis.
            opacities: (n,) levels of the opacities, >= 0.
            start: number of the first of these splats in the file.
        """
        a, b, c = (logarithms(axis) for axis in scales)
        low, high = np.minimum(a, b), np.maximum(a, b)
        largest, smallest = np.maximum(high, c), np.minimum(low, c)
        between = a + b + c - largest - smallest
        w = self.scales
        weights: I64 = (w[0] * largest + w[1] * between + w[2] * smallest) >> SHIFT
        weights += self._of_opacities(opacities)
        group = np.arange(start, start + len(weights)) >> self.group_bits
        weights += GROUP_UNIT * self.groups.astype(np.int64)[group]
        return weights

    def classes(self, scales: Sequence[Levels], opacities: Levels, start: int = 0) -> tuple[I8, I8]:
        """(n,) int8 quarter octaves by which scale factors of DC, and of AC, are above those of the header.

        The arguments are those of :meth:`weights`.
        """
        weights = self.weights(scales, opacities, start)
        dc, ac = (
            np.clip((weights * power + offset) >> CLASS_SHIFT, -CLASSES, CLASSES - 1).astype(np.int8)
            for power, offset in zip(self.powers, self.offsets, strict=True)
        )
        return dc, ac

    def _of_opacities(self, levels: Levels) -> I64:
        if self.knot_shift <= 8 and levels.dtype == np.uint8:
            table: I64 = self._interpolated(np.arange(256)).take(levels)
            return table
        return self._interpolated(levels)

    def _interpolated(self, levels: Levels) -> I64:
        place, part = places(levels, self.first_knot, self.knot_shift)
        knots = np.array(self.opacities, np.int64)
        between: I64 = knots[place] + (part * (knots[place + 1] - knots[place]) >> self.knot_shift)
        return between


@definition
def colour_classes(steps: ColourSteps, scales: Sequence[Levels], opacities: Levels, start: int = 0) -> tuple[I8, I8]:
    """:meth:`ColourSteps.classes`."""
    return steps.classes(scales, opacities, start)


def logarithms(levels: Levels) -> I64:
    """(n,) levels of scales, >= 0, to about 16 · log2(4 · level), linear between powers of two; 0 for level 0."""
    if levels.dtype != np.uint8 and int(levels.max(initial=0)) >= _TABLE:
        return _logarithms(levels)
    small: I64 = _small_logarithms().take(levels)
    return small


@lru_cache(maxsize=1)
def _small_logarithms() -> I64:
    return _logarithms(np.arange(_TABLE))


def _logarithms(levels: Levels) -> I64:
    quarters = np.maximum(4 * _at_most(levels, _LARGEST_SCALE), 1)
    exponent = np.frexp(quarters.astype(np.float64))[1].astype(np.int64) - 1  # exact below 2^53
    logarithm: I64 = OCTAVE * exponent + ((OCTAVE * (quarters - (1 << exponent))) >> exponent)
    return logarithm


def places(levels: Levels, first_knot: int, knot_shift: int) -> tuple[I64, I64]:
    """Where some levels of opacities lie: the place below, 0 to KNOTS − 2, and levels above it."""
    first, whole = first_knot << knot_shift, 1 << (_SPACES_BITS + knot_shift)
    above = np.maximum(_at_most(levels, first + whole - 1) - first, 0)
    return above >> knot_shift, above & ((1 << knot_shift) - 1)


def _at_most(levels: Levels, most: int) -> I64:
    """Integers >= 0 of any size."""
    return np.minimum(levels.astype(np.uint64, copy=False), np.uint64(most)).astype(np.int64)


def factors(scale_factor: float, classes: I8 | None = None) -> F32:
    """Scale factors of colours in single precision: (n,) of some classes, or (1,) of class 0.

    2 to the power of a quarter of the class, rounded to single precision, times the scale factor, rounded again.
    """
    if classes is None:
        return np.full(1, scale_factor, np.float32)
    of_classes: F32 = (np.float32(scale_factor) * _ratios()).take(classes.astype(np.intp) + CLASSES)
    return of_classes


@lru_cache(maxsize=1)
def _ratios() -> F32:
    """(2 CLASSES,) 2^(class / 4), from the four in an octave, which are known to all their digits."""
    octave = np.array([float.fromhex(h) for h in ("0x1p+0", "0x1.306fep+0", "0x1.6a09e6p+0", "0x1.ae89fap+0")])
    k = np.arange(-CLASSES, CLASSES)
    ratios: F32 = np.ldexp(octave[k & 3], k >> 2).astype(np.float32)
    return ratios
