"""The encoder of bundles by C: :class:`BundleEncoder`. Its input is the encoder's own, whose sizes are checked here."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Model
from potr_cl.codec.bundles.streams import Stream, tokens_of
from potr_cl.codec.native.bundles import SECTIONS, STREAMS
from potr_cl.codec.sections import SH, Property
from potr_cl.host.threads import Spare
from potr_cl.native.declarations import CFunctions, address

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]

#: Rows of the sums of products, and numbers of a stream.
COLUMNS, NUMBERS = 22, 21
_TOKENS = 256
_LANES, _BUNDLE = 32, 8192
#: So many threads' working memory stays for the next file: 12 MB each, of which a usual file writes to 4.
_KEPT = 8
_MOST_ALPHABET, _GROUPS, _LOGS = 252, 64, 4096
#: Words that a bundle can have at most, for each splat: of 13 streams of splats, and of 15 coefficients' patterns and
#: values. A token and its bits take four at most.
_WORDS = 4 * (13 + 15 * 4)

_POINTER, _WORD, _NUMBER = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int32


class _Integers(ctypes.Structure):
    _fields_ = (
        ("opacity", _POINTER),
        ("scales", _POINTER * 3),
        ("rotations", _POINTER * 3),
        ("dc", _POINTER * 3),
        ("ac", _POINTER * 45),
        ("classes", _POINTER),
        ("splats", _WORD),
    )


class _Stream(ctypes.Structure):
    _fields_ = (
        ("sizes", _POINTER),
        ("classes", _POINTER),
        ("intervals", _POINTER),
        ("numbers", _NUMBER * NUMBERS),
        ("terms", _NUMBER),
        ("coefficients", _NUMBER),
        ("unused", _NUMBER),
    )


@dataclass(frozen=True)
class CodedBundle:
    """A bundle as it is stored.

    Attributes:
        words: of each section, in the order of decoding.
        states: (32,) of the lanes of the chain that begins with opacities.
        rotation_states: (32,) of the other.
    """

    words: Sequence[U16]
    states: U32
    rotation_states: U32


@lru_cache(maxsize=1)
def _memory(nbytes: int) -> Spare[U8]:
    """What threads encode bundles in, of all files: new memory would take them longer than to survey a bundle."""
    return Spare(lambda: np.zeros(nbytes, np.uint8), most=_KEPT)


class BundleEncoder:
    """A file's integers, whose bundles any thread may go through.

    Args:
        c: the library's functions.
        values: integers of each section, int32 (N,) each; opacities at least. Sections that are left out are 0.
        streams: of all sections, in the order of decoding.
        classes: (N,) of the steps of DC, -32 to 31.
    """

    def __init__(
        self,
        c: CFunctions,
        values: Mapping[Property, Sequence[I32]],
        streams: Sequence[Stream],
        classes: NDArray[np.int8],
    ) -> None:
        self._c = c
        (opacity,) = values[Property.OPACITY]
        self._splats = splats = len(opacity)
        self._kept: list[NDArray[Any]] = []
        self._integers = _Integers()
        self._integers.splats = splats
        self._integers.opacity = self._keep(opacity, np.int32, splats)
        self._integers.classes = self._keep(classes, np.int8, splats)
        places = {
            Property.SCALE: (self._integers.scales, 0),
            Property.ROTATION: (self._integers.rotations, 0),
            **{prop: (self._integers.ac, 3 * degree**2 - 3) for degree, prop in enumerate(SH)},
            Property.SH0: (self._integers.dc, 0),
        }
        for prop, (to, first) in places.items():
            own = values.get(prop, ())
            if own and len(own) != prop.streams:
                raise TypeError("the native path was given a part of a section")
            for k, integers in enumerate(own, start=first):
                to[k] = self._keep(integers, np.int32, splats)
        self._streams = (_Stream * STREAMS)()
        self._work = _memory(c["potr_bundles_encoding"]())
        self._sums = Spare(lambda: (np.zeros((STREAMS, COLUMNS, COLUMNS), np.int64), np.zeros(STREAMS, np.uint32)))
        self._grouping = np.empty(c["potr_bundles_grouping"](), np.uint8)
        self._words = Spare(lambda: np.empty(_WORDS * _BUNDLE + 2, np.uint16))
        for place, stream in zip(self._streams, streams, strict=True):
            number, some = len(stream.terms), stream.coefficients
            if number > 12 or number + some > NUMBERS - 2:
                raise TypeError("the native path was given too many terms")
            sizes = np.zeros(_TOKENS, np.int16)
            sizes[: len(stream.sizes)] = stream.sizes
            place.sizes = self._keep(sizes, np.int16, _TOKENS)
            place.terms, place.coefficients = number, some

    def _keep(self, array: NDArray[Any], dtype: type[np.generic], number: int) -> int:
        self._kept.append(array)
        return address(array, dtype, number)

    def survey(self, bundle: int, at_least: int) -> None:
        """Add a bundle to what weights are fitted to.

        Args:
            bundle: which.
            at_least: samples that are taken of a stream, where it has as many.
        """
        with self._sums.taken() as (grams, largest), self._work.taken() as work:
            self._c["potr_bundles_survey"](
                ctypes.byref(self._integers),
                self._checked(bundle),
                self._streams,
                work.ctypes.data,
                at_least,
                address(grams, np.int64, grams.size, True),
                address(largest, np.uint32, STREAMS, True),
            )

    def grams(self) -> I64:
        """(25, 22, 22) sums of products of terms, recent sizes, constant, coefficients and size; not those below the
        diagonals."""
        total: I64 = np.sum([grams for grams, _ in self._sums.all()], axis=0)
        return total

    @cached_property
    def alphabets(self) -> list[int]:
        """Of each stream: more than its largest token. To be asked for once all bundles have been surveyed."""
        most = np.max([largest for _, largest in self._sums.all()], axis=0)
        return [token + 1 for token in tokens_of(most.astype(np.int64)).tolist()]

    def take_numbers(self, numbers: Sequence[Sequence[int]]) -> None:
        """What tells the contexts of each stream: weights of terms and of recent sizes, constant, biases."""
        self._width = width = max(self.alphabets)
        self._counts = Spare(lambda: np.zeros((STREAMS, _TOKENS, width), np.uint32))
        for to, some in zip(self._streams, numbers, strict=True):
            if len(some) != to.terms + 2 + to.coefficients:
                raise TypeError("the native path was given too few numbers")
            to.numbers[: len(some)] = list(some)

    def count(self, bundle: int) -> None:
        """Add a bundle to the counts that contexts are made of; numbers have been taken."""
        with self._counts.taken() as counts, self._work.taken() as work:
            self._c["potr_bundles_count"](
                ctypes.byref(self._integers),
                self._checked(bundle),
                self._streams,
                work.ctypes.data,
                self._width,
                address(counts, np.uint32, STREAMS * _TOKENS * self._width, True),
            )

    def model(self, stream: int, alphabet: int, logs: I64) -> Model | None:
        """Contexts of a stream that was counted, and their frequencies, for one thread at a time; None: it has nothing.

        Args:
            stream: its number.
            alphabet: more than its largest token.
            logs: (4096,) log₂ of each number, in units of 2^-16.
        """
        if not 0 < alphabet <= self._width:
            raise TypeError("the native path was given no tokens, or too many")
        total = np.zeros((_TOKENS, alphabet), np.uint32)
        for counts in self._counts.all():
            total += counts[stream, :, :alphabet]
        if not total.any():
            return None
        classes, frequencies = np.empty(_TOKENS, np.uint8), np.empty(_GROUPS * alphabet, np.uint16)
        number = self._c["potr_bundles_contexts"](
            address(total, np.uint32, _TOKENS * alphabet),
            alphabet,
            address(logs, np.int64, _LOGS),
            self._grouping.ctypes.data,
            address(classes, np.uint8, _TOKENS, True),
            address(frequencies, np.uint16, len(frequencies), True),
        )
        return Model(classes, frequencies[: number * alphabet].reshape(number, alphabet).astype(np.int64))

    def take_models(self, models: Sequence[Model]) -> None:
        """What :meth:`code` codes with; every token of the counted bundles has a frequency."""
        for to, model in zip(self._streams, models, strict=True):
            contexts, alphabet = model.frequencies.shape
            if int(model.classes.max()) >= contexts:
                raise TypeError("the native path was given contexts without frequencies")
            intervals = np.ones((contexts, _TOKENS), np.uint32)
            wide = model.frequencies.astype(np.uint32)
            intervals[:, :alphabet] = (np.cumsum(wide, axis=1, dtype=np.uint32) - wide) << np.uint32(16) | wide
            np.maximum(intervals, 1, out=intervals)
            to.intervals = self._keep(intervals, np.uint32, contexts * _TOKENS)
            to.classes = self._keep(model.classes, np.uint8, _TOKENS)

    def code(self, bundle: int) -> CodedBundle:
        """Code a bundle."""
        counts = np.zeros(SECTIONS, np.uint64)
        states, turned = np.empty(_LANES, np.uint32), np.empty(_LANES, np.uint32)
        with self._words.taken() as words, self._work.taken() as work:
            first = self._c["potr_bundles_code"](
                ctypes.byref(self._integers),
                self._checked(bundle),
                self._streams,
                work.ctypes.data,
                address(words, np.uint16, len(words), True),
                len(words),
                address(counts, np.uint64, SECTIONS, True),
                address(states, np.uint32, _LANES, True),
                address(turned, np.uint32, _LANES, True),
            )
            ends = np.cumsum(counts.astype(np.int64))
            return CodedBundle(np.split(words[first:].copy(), ends[:-1]), states, turned)

    def _checked(self, bundle: int) -> int:
        if not 0 <= bundle * _BUNDLE < self._splats:
            raise TypeError("the native path was asked for a bundle that is not there")
        return bundle
