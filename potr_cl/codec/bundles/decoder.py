"""The decoder of coder BUNDLES: :class:`Reader`, from the sections of a file, which it does not trust, to integers.

Bundles are decoded one by one by the native path, and side by side by NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Fitted
from potr_cl.codec.bundles.layout import BUNDLE, LANES, Bundles, Items, Layout, Levels, joined
from potr_cl.codec.bundles.ranges import Words, decode_stream, integer_type
from potr_cl.codec.bundles.sections import MAIN, ORDER, ROTATION, Section
from potr_cl.codec.bundles.streams import LOWEST, band, check_end, differences, no_words_left, step_terms, streams_of
from potr_cl.codec.native.bundles import FINE, TOO_FEW_WORDS, BundledFile
from potr_cl.codec.sections import Property
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.errors import DataError
from potr_cl.native.declarations import CFunctions
from potr_cl.native.library import vectors
from potr_cl.native.table import definition

I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Integers = NDArray[np.signedinteger]


#: Splats whose steps are found at a time: few enough that temporaries are small.
_AT_A_TIME = 1 << 15


@dataclass(frozen=True)
class Wanted:
    """What to decode. Later parts of a chain need the earlier ones.

    Attributes:
        sections: of the main chain, so many.
        rotations: whether rotations are.
    """

    sections: int = len(MAIN)
    rotations: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.sections <= len(MAIN) or (self.rotations and self.sections < 2):
            raise ValueError("rotations need the scales, and all need the opacities")

    @property
    def keys(self) -> list[Property]:
        """Of the sections that it takes, in the order of decoding."""
        return [*MAIN[: self.sections], *([ROTATION] if self.rotations else [])]


EVERYTHING = Wanted()


class Reader:
    """A file's splats, bundle by bundle.

    Args:
        splats: n of the file.
        open_section: gives the stored bytes of a section and its name, None if the file has none; called when it is
            needed.
        open_steps: gives the steps of colours, None if the file has none; called when they are needed.

    Raises:
        DataError: damaged.
    """

    def __init__(
        self,
        splats: int,
        open_section: Callable[[Property], tuple[memoryview, str] | None],
        open_steps: Callable[[], ColourSteps | None],
    ) -> None:
        self.bundles = Bundles(splats)
        self._open_section, self._open_steps = open_section, open_steps
        self._sections: dict[Property, Section | None] = {}
        self._files: dict[Wanted, list[BundledFile]] = {}

    @cached_property
    def steps(self) -> ColourSteps | None:
        """The steps of colours. Raises DataError if damaged."""
        return self._open_steps()

    def section(self, key: Property) -> Section | None:
        """A section; None if the file has none. Raises DataError if damaged."""
        if key not in self._sections:
            found = self._open_section(key)
            self._sections[key] = None if found is None else Section(key, found[0], self.bundles, found[1])
        return self._sections[key]

    def levels(self, first: int, last: int, wanted: Wanted = EVERYTHING) -> Levels:
        """Decode some bundles.

        Args:
            first, last: the first bundle, and the one behind the last.
            wanted: what of them.

        Raises:
            DataError: damaged.
        """
        file = self.bundled_file(wanted)
        if file is not None:
            work = file.work()
            parts = []
            for bundle in range(first, last):
                said, number, levels = file.levels(bundle, wanted.sections, wanted.rotations, work)
                check_said(self, said, number)
                parts.append(levels)
            return joined(parts)
        run = _Run(self, first, last, wanted)
        for key in wanted.keys:
            run.decode(key)
        run.check_end(wanted)
        return run.levels

    def bundled_file(self, wanted: Wanted = EVERYTHING) -> BundledFile | None:
        """What the native path decodes bundles from; None where NumPy is to be taken. Raises DataError if damaged."""
        # By whatever path, they are looked at before anything is decoded.
        sections = {ORDER.index(key): self.section(key) for key in wanted.keys}
        steps = self.steps if wanted.sections > 2 else None
        return bundled_file(self.bundles.splats, sections, steps, self._files.setdefault(wanted, []))


@definition
def bundled_file(
    splats: int, sections: Mapping[int, Section | None], steps: ColourSteps | None, kept: list[BundledFile]
) -> BundledFile | None:
    """What C decodes bundles from.

    Args:
        splats: n of the file.
        sections: by their place in the order of decoding.
        steps: of colours.
        kept: it is made once.
    """
    return None


def _bundled_file_by_c(
    c: CFunctions,
    splats: int,
    sections: Mapping[int, Section | None],
    steps: ColourSteps | None,
    kept: list[BundledFile],
) -> Any:
    there = {number: section for number, section in sections.items() if section is not None}
    if not all(section.fits for section in there.values()):
        return NotImplemented
    if not kept:
        kept.append(BundledFile(c, splats, there, steps, vectors()))
    return kept[0]


class _Run:
    """Some bundles that are decoded side by side."""

    def __init__(self, reader: Reader, first: int, last: int, wanted: Wanted) -> None:
        start, stop = first * BUNDLE, min(last * BUNDLE, reader.bundles.splats)
        self._reader, self._first, self._last = reader, first, last
        self._bundles = Bundles(stop - start)
        self._terms: dict[str, I16] = {}
        chains = (MAIN[0], ROTATION) if wanted.rotations else (MAIN[0],)
        self._states = {key: self._states_of(key) for key in chains}
        self.levels = Levels(start, stop)

    def _states_of(self, key: Property) -> I64:
        """(columns,) states of a chain at its beginning; lanes that are not there rest at the end."""
        columns = np.full(LANES * self._bundles.number, LOWEST, np.int64)
        section = self._reader.section(key)
        if section is not None:
            lanes = self._reader.bundles.lanes
            start = int(lanes[: self._first].sum())
            there = np.arange(LANES) < self._bundles.lanes[:, None]
            columns[there.ravel()] = section.states[start : start + int(self._bundles.lanes.sum())]
        return columns

    def decode(self, key: Property) -> None:
        if key is Property.OPACITY:
            (self.levels.opacities,) = self._dense(key)
        elif key is Property.SCALE:
            self.levels.scales = self._dense(key)
        elif key is Property.ROTATION:
            # It comes last, and needs no other terms.
            self._terms = {name: self._terms[name] for name in (f"scale {axis}" for axis in range(3))}
            scales = list(self._terms.values())
            self._terms.update({f"difference {k}": each for k, each in enumerate(differences(scales))})
            self.levels.rotations = [_signed(values) for values in self._dense(key)]
        elif key is Property.SH0:
            self._find_steps()
            self.levels.dc = [_signed(values) for values in self._dense(key)]
        else:
            self._decode_band(key)

    def check_end(self, wanted: Wanted) -> None:
        """Check that every lane of the chains that were read to their ends is back where its encoder began."""
        for key, read in ((ROTATION, wanted.rotations), (MAIN[0], wanted.sections == len(MAIN))):
            section = self._reader.section(key) if read else None
            if section is not None:
                check_end(True, self._states[key].astype(np.uint32), section.what)

    def _chain(self, key: Property) -> I64:
        return self._states[ROTATION if key == ROTATION else MAIN[0]]

    def _dense(self, key: Property) -> list[Integers]:
        """Integers of the streams of an item a splat."""
        section = self._reader.section(key)
        splats = self._bundles.splats
        if section is None:
            for stream in streams_of(key):
                self._terms[stream.name] = np.full(splats, stream.sizes[0], np.int16)
            return [np.zeros(splats, np.int16) for _ in streams_of(key)]
        words = section.of(self._first, self._last)
        return [
            self._stream(key, words, fitted, self._bundles.dense, self._sums(fitted, self._terms))
            for fitted in section.streams
        ] + self._finished(words, section)

    def _finished(self, words: Words, section: Section) -> list[Integers]:
        if not words.all_taken:
            raise DataError(f"section '{section.what}' does not end where its last token does")
        return []

    def _stream(self, key: Property, words: Words, fitted: Fitted, layout: Layout, base: I32) -> Integers:
        """Integers of a stream, mapped to unsigned; their sizes become a term. ``base``: (items,) weighted sums."""
        rows = layout.laid(base, np.int64)
        del base
        tokens, integers = decode_stream(layout, rows, fitted, self._chain(key), words)
        self._terms[fitted.stream.name] = fitted.stream.sizes.astype(np.int16).take(tokens)
        return integers

    def _sums(self, fitted: Fitted, terms: dict[str, I16]) -> I32:
        """(n,) of each splat: weighted sums of those terms of a stream that there are, and its constant.

        They are below 2^31: sizes are below 2^10, sums of sizes below 2^14, weights 2^15.
        """
        sums = np.full(self._bundles.splats, fitted.constant, np.int32)
        for name, weight in zip(fitted.stream.terms, fitted.terms.tolist(), strict=True):
            if weight and name in terms:
                sums += np.multiply(terms[name], weight, dtype=np.int32)
        return sums

    def _find_steps(self) -> None:
        """What the steps of splats' colours tell of them."""
        steps, levels = self._reader.steps, self.levels
        levels.classes = classes = np.zeros((2, self._bundles.splats), np.int8)
        if steps is not None and levels.scales is not None and levels.opacities is not None:
            for start in range(0, self._bundles.splats, _AT_A_TIME):
                some = slice(start, start + _AT_A_TIME)
                scales = [axis[some] for axis in levels.scales]
                classes[:, some] = steps.classes(scales, levels.opacities[some], levels.start + start)
        self._terms["step"] = step_terms(classes[0]).astype(np.int16)

    def _decode_band(self, key: Property) -> None:
        """The AC coefficients of a degree."""
        terms = self._terms
        splats = self._bundles.splats
        for c in range(3):
            terms.setdefault(f"sum {c}", np.zeros(splats, np.int16))
        section = self._reader.section(key)
        if section is None:
            return
        first, end = band(key)
        words = section.of(self._first, self._last)
        mask, pattern, *values = section.streams
        masks = self._stream(key, words, mask, self._bundles.dense, self._sums(mask, terms))
        splat, which = _items(masks.astype(np.uint8), end - first)
        of_splats = {name: terms[name] for name in (*(f"sum {c}" for c in range(3)), "mask", "step")}

        def base(fitted: Fitted, at: NDArray[np.bool_] | slice, of_items: dict[str, I16]) -> I32:
            """Of some items: what their splats tell, then what they do themselves."""
            sums: I32 = self._sums(fitted, of_splats).take(splat[at])
            sums += fitted.biases.astype(np.int32).take(which[at])
            for name, weight in zip(fitted.stream.terms, fitted.terms.tolist(), strict=True):
                if weight and name in of_items:
                    sums += np.multiply(of_items[name][at], weight, dtype=np.int32)
            return sums

        layout = self._bundles.items(splat)
        patterns = self._stream(key, words, pattern, layout, base(pattern, slice(None), {})).astype(np.uint8)
        del layout
        wide = np.result_type(*(integer_type(fitted.alphabet) for fitted in values))
        channels = np.zeros((3, len(splat)), wide)
        of_items = {"pattern": terms["pattern"]}
        for c, fitted in enumerate(values):
            there = (patterns >> np.uint8(c) & np.uint8(1)).view(bool)
            integers = self._stream(
                key, words, fitted, self._bundles.items(splat[there]), base(fitted, there, of_items)
            )
            of_items[f"value {c}"] = np.zeros(len(splat), np.int16)
            of_items[f"value {c}"][there] = terms[f"value {c}"]
            channels[c, there] = _signed(integers + 1)
        self._finished(words, section)
        for c in range(3):
            sizes = of_items[f"value {c}"]
            terms[f"sum {c}"] += np.bincount(splat, weights=sizes, minlength=splats).astype(np.int16)
        self.levels.ac.append(Items(splat, which + np.uint8(first), channels))


def _items(masks: NDArray[np.uint8], width: int) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """The bits of some masks of so many: the place of each one's mask, and which bit it is."""
    bits = np.ascontiguousarray(np.unpackbits(masks[:, None], axis=1, bitorder="little")[:, :width]).view(bool)
    places = np.flatnonzero(bits).astype(np.int32)
    splat = places // np.int32(width)
    places -= splat * np.int32(width)
    return splat, places.astype(np.uint8)


def check_said(reader: Reader, said: int, number: int) -> None:
    """What the native path says of a bundle, and of the section at fault. Raises DataError if damaged."""
    if said == FINE:
        return
    section = reader.section(ORDER[number])
    what = "" if section is None else section.what
    if said == TOO_FEW_WORDS:
        raise no_words_left(what)
    check_end(False, np.zeros(0, np.uint32), what)


def _signed(mapped: Integers) -> Integers:
    return (mapped >> 1) ^ -(mapped & 1)
