"""Bundles by C: :class:`BundledFile` is a block's sections of bundles as C takes them.

C trusts what it is told: that is made here, of arrays whose sizes are checked.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Fitted
from potr_cl.codec.bundles.layout import Items, Levels
from potr_cl.codec.bundles.sections import Section
from potr_cl.codec.steps.rule import KNOTS, ColourSteps
from potr_cl.native.declarations import LARGEST, CFunctions, address

I8 = NDArray[np.int8]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
U32 = NDArray[np.uint32]

_TOTAL, _TOKENS = 4096, 256
_BUNDLE, _LANE = 8192, 256
_WEIGHTS, _BIASES = 12, 8
#: Where the streams of each section begin, in the order of decoding, and how many there are; rotations come last.
_STREAMS = (0, 1, 4, 7, 12, 17, 22, 25)
SECTIONS, STREAMS = len(_STREAMS) - 1, _STREAMS[-1]
_COEFFICIENTS = 15

_POINTER, _WORD, _NUMBER = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int32


class _Stream(ctypes.Structure):
    _fields_ = (
        ("classes", _POINTER),
        ("slots", _POINTER),
        ("intervals", _POINTER),
        ("sizes", _POINTER),
        ("weights", _NUMBER * _WEIGHTS),
        ("biases", _NUMBER * _BIASES),
        ("recent", _NUMBER),
        ("constant", _NUMBER),
        ("alphabet", _NUMBER),
        ("by_vectors", _NUMBER),
    )


class _Steps(ctypes.Structure):
    _fields_ = (
        ("groups", _POINTER),
        ("group_bits", _NUMBER),
        ("knot_shift", _NUMBER),
        ("first_knot", _NUMBER),
        ("powers", _NUMBER * 2),
        ("offsets", _NUMBER * 2),
        ("scales", _NUMBER * 3),
        ("knots", _NUMBER * KNOTS),
    )


class _File(ctypes.Structure):
    _fields_ = (
        ("streams", _Stream * STREAMS),
        ("words", _POINTER * SECTIONS),
        ("starts", _POINTER * SECTIONS),
        ("states", _POINTER),
        ("rotation_states", _POINTER),
        ("splats", _WORD),
        ("steps", _Steps),
    )


class _Levels(ctypes.Structure):
    _fields_ = (
        ("opacity", _POINTER),
        ("scales", _POINTER),
        ("rotations", _POINTER),
        ("dc", _POINTER),
        ("item_splats", _POINTER),
        ("item_coefficients", _POINTER),
        ("item_channels", _POINTER),
        ("items", _WORD * 3),
    )


def native_steps(steps: ColourSteps, splats: int) -> _Steps:
    """What C takes of the steps of colours of N splats; the array of their groups must be kept."""
    # Both are checked where steps are read, and once more: C shifts by them.
    if not 0 <= steps.group_bits <= 40 or not 0 <= steps.knot_shift <= 40:
        raise TypeError("the native path was given impossible steps")
    return _Steps(
        address(steps.groups, np.int8, -(-splats >> steps.group_bits)),
        steps.group_bits,
        steps.knot_shift,
        steps.first_knot,
        steps.powers,
        steps.offsets,
        steps.scales,
        steps.opacities,
    )


def step_classes(c: CFunctions, steps: ColourSteps, scales: I32, opacities: I32) -> tuple[I8, I8]:
    """(N,) classes of the steps of DC, and of AC.

    Args:
        steps: of colours.
        scales: (3, N) levels, 0 to 2^29 - 1.
        opacities: (N,) levels, 0 to 2^29 - 1.
    """
    n = len(opacities)
    for levels in (scales, opacities):
        if int(levels.min(initial=0)) < 0 or int(levels.max(initial=0)) >= LARGEST:
            raise TypeError("the native path was given levels that are negative or too large")
    dc, ac = np.empty((2, n), np.int8)
    c["potr_steps_classes"](
        ctypes.byref(native_steps(steps, n)),
        address(scales, np.int32, 3 * n),
        address(opacities, np.int32, n),
        n,
        address(dc, np.int8, n, True),
        address(ac, np.int8, n, True),
    )
    return dc, ac


def colour_classes(
    c: CFunctions, steps: ColourSteps, scales: Sequence[NDArray[np.integer]], opacities: NDArray[np.integer],
    start: int = 0,
) -> Any:  # fmt: skip
    """The twin of :func:`potr_cl.codec.steps.rule.colour_classes`, which cannot know this module."""
    group = 1 << steps.group_bits
    if start % group or any(levels.dtype.itemsize > 2 for levels in (*scales, opacities)):
        return NotImplemented
    own = replace(steps, groups=steps.groups[start // group :][: -(-len(opacities) // group)])
    return step_classes(c, own, np.stack(scales, dtype=np.int32), opacities.astype(np.int32))


#: What C says of a bundle, and the section at fault.
FINE, TOO_FEW_WORDS, TOO_MANY_WORDS, BAD_END, BEYOND_TABLE = range(5)


class BundledFile:
    """A file's sections, from which bundles are decoded one by one, by any thread.

    Args:
        c: the library's functions.
        splats: N of the file.
        sections: by their place in the order of decoding (opacity, scale, DC, degrees 1 to 3, rotation); opacity's at
            least.
        steps: of colours, for files that have them.
        vectors: whether to look tokens up by vectors, where the processor can.

    Attributes:
        splats: as given.
    """

    def __init__(
        self,
        c: CFunctions,
        splats: int,
        sections: Mapping[int, Section],
        steps: ColourSteps | None = None,
        vectors: bool = True,
    ) -> None:
        self._c = c
        self._vectors = bool(vectors and c["potr_bundles_vectors"]())
        self.splats = splats
        self._kept: list[NDArray[Any]] = []
        self._file = _File()
        self._file.splats = splats
        bundles, lanes = -(-splats // _BUNDLE), splats // _BUNDLE * (_BUNDLE // _LANE) + -(-(splats % _BUNDLE) // _LANE)
        models: dict[int, Fitted] = {}
        for number, section in sections.items():
            first, end = _STREAMS[number : number + 2]
            if len(section.streams) != end - first or len(section.counts) != bundles or int(section.counts.min()) < 0:
                raise TypeError("the native path was given a section without all of its parts")
            models.update(enumerate(section.streams, start=first))
            starts = np.zeros(bundles + 1, np.uint64)
            np.cumsum(section.counts, out=starts[1:])
            self._file.words[number] = self._keep(section.words, np.uint8, 2 * int(starts[-1]))
            if not self._file.words[number]:
                self._file.words[number] = self._keep(np.zeros(2, np.uint8), np.uint8, 2)
            self._file.starts[number] = self._keep(starts, np.uint64, bundles + 1)
        self._describe(models)
        self._file.states = self._keep(sections[0].states.astype(np.uint32), np.uint32, lanes)
        if SECTIONS - 1 in sections:
            self._file.rotation_states = self._keep(sections[SECTIONS - 1].states.astype(np.uint32), np.uint32, lanes)

        if steps is not None:
            self._kept.append(steps.groups)
            self._file.steps = native_steps(steps, splats)

    def _keep(self, array: NDArray[Any], dtype: type[np.generic], number: int, writable: bool = False) -> int:
        self._kept.append(array)
        return address(array, dtype, number, writable)

    def _describe(self, models: Mapping[int, Fitted]) -> None:
        """Tell C of streams, all at once: each call of NumPy takes as long as what C does for a stream."""
        number = len(models)
        contexts = [len(model.frequencies) for model in models.values()]
        # Vectors of slots are looked up with some bytes too many.
        slots, intervals = np.empty(sum(contexts) * _TOTAL + 3, np.uint8), np.empty(sum(contexts) * _TOKENS, np.uint32)
        sizes = np.zeros((number, _TOKENS), np.int16)
        classes = np.concatenate([model.classes for model in models.values()])
        at_slots = self._keep(slots, np.uint8, len(slots), True)
        at_intervals = self._keep(intervals, np.uint32, len(intervals), True)
        for row, model in zip(sizes, models.values(), strict=True):
            alphabet, own = model.alphabet, model.stream.sizes
            if alphabet > min(len(own), _TOKENS):
                raise TypeError("the native path was given tokens without sizes")
            row[:alphabet] = own[:alphabet]
        if (classes.reshape(number, 256).max(axis=1) >= contexts).any():
            raise TypeError("the native path was given contexts without frequencies")
        at_sizes, at_classes = self._keep(sizes, np.int16, sizes.size), self._keep(classes, np.uint8, 256 * number)
        small = (sizes.max(axis=1) < _TOKENS) & self._vectors
        for k, (place, model) in enumerate(models.items()):
            if len(model.terms) > _WEIGHTS or len(model.biases) > _BIASES:
                raise TypeError("the native path was given too many weights")
            to, alphabet = self._file.streams[place], model.alphabet
            to.slots, to.intervals = at_slots, at_intervals
            to.sizes, to.classes = at_sizes + 2 * _TOKENS * k, at_classes + 256 * k
            frequencies = np.ascontiguousarray(model.frequencies, np.uint16)
            rows = address(frequencies, np.uint16, contexts[k] * alphabet)
            if self._c["potr_bundles_table"](rows, contexts[k], alphabet, to.sizes, at_slots, at_intervals):
                raise TypeError("the native path was given frequencies that do not add up")
            # The next stream's begin where the bytes too many of this one would be.
            at_slots, at_intervals = at_slots + contexts[k] * _TOTAL, at_intervals + 4 * contexts[k] * _TOKENS
            to.weights[: len(model.terms)] = model.terms.tolist()
            to.biases[: len(model.biases)] = model.biases.tolist()
            to.recent, to.constant, to.alphabet = model.recent, model.constant, alphabet
            to.by_vectors = bool(small[k])

    def work(self) -> U8:
        """What a thread needs to decode bundles, one at a time."""
        work = np.empty(self._c["potr_bundles_work"]() + 64, np.uint8)
        start = -work.ctypes.data % 64
        aligned = work[start : len(work) - 64 + start]
        self._c["potr_bundles_begin"](address(aligned, np.uint8, len(aligned), True))
        return aligned

    def levels(self, bundle: int, sections: int, rotations: bool, work: U8) -> tuple[int, int, Levels]:
        """Decode a bundle.

        Args:
            bundle: which.
            sections: so many of the chain that begins with opacities.
            rotations: whether these are decoded; then the scales must be.
            work: of :meth:`work`.

        Returns:
            What C says, the section at fault, and the integers, int32, if nothing is.
        """
        n = self.check(bundle, sections, rotations)
        integers = [np.zeros((k, n), np.int32) for k in (1, 3, 3, 3)]
        splats, coefficients = np.empty(_COEFFICIENTS * n, np.uint16), np.empty(_COEFFICIENTS * n, np.uint8)
        channels = np.empty((3, _COEFFICIENTS * n), np.int32)
        out = _Levels(
            *(address(array, np.int32, array.size, True) for array in integers),
            address(splats, np.uint16, splats.size, True),
            address(coefficients, np.uint8, coefficients.size, True),
            address(channels, np.int32, channels.size, True),
        )
        section = ctypes.c_int()
        said = self._c["potr_bundles_levels"](
            ctypes.byref(self._file), bundle, sections, rotations, address(work, np.uint8, len(work), True),
            ctypes.byref(out), ctypes.byref(section),
        )  # fmt: skip
        opacities, scales, turned, dc = integers
        found = Levels(bundle * _BUNDLE, bundle * _BUNDLE + n, opacities[0])
        found.scales = list(scales) if sections > 1 else None
        found.dc = list(dc) if sections > 2 else None
        found.rotations = list(turned) if rotations else None
        ends = np.cumsum((0, *out.items))
        for degree in range(sections - 3):
            if self._file.words[3 + degree]:
                own = slice(ends[degree], ends[degree + 1])
                found.ac.append(Items(splats[own].astype(np.int32), coefficients[own], channels[:, own]))
        return said, section.value, found

    @property
    def as_c(self) -> ctypes.Structure:
        """What C takes; it lives as long as this object."""
        return self._file

    def degree(self, sections: int) -> int:
        """Of the AC coefficients in so many sections of the chain."""
        return max((number - 2 for number in range(3, sections) if self._file.words[number]), default=0)

    def check(self, bundle: int, sections: int, rotations: bool) -> int:
        """Splats of a bundle, of which so much can be decoded. Raises TypeError if it cannot."""
        if not 0 <= bundle * _BUNDLE < self.splats or not 1 <= sections < SECTIONS or (rotations and sections < 2):
            raise TypeError("the native path was asked for what is not there")
        return min(self.splats - bundle * _BUNDLE, _BUNDLE)
