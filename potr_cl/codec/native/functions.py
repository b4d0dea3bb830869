"""The C functions for NumPy arrays: :class:`Functions`.

C trusts the sizes that it is told. They are read off the arrays here, and arrays of another type, shape or layout than
a function takes are refused before it is called.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.arrays import KINDS, address, addresses, kind_of
from potr_cl.codec.native.bundles import BundledFile, SectionWords, native_steps
from potr_cl.codec.native.bundles_encode import BundleEncoder
from potr_cl.codec.native.declarations import declared
from potr_cl.codec.native.octree import OctreeFunctions
from potr_cl.codec.native.octree_build import OctreeBuilding
from potr_cl.codec.native.quantising import Quantising
from potr_cl.codec.native.share import BundleShare
from potr_cl.codec.steps.rule import CLASSES, ColourSteps

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I8 = NDArray[np.int8]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]

_TOTAL = 4096  # what a context's frequencies add up to
_CONTEXT_TERMS = 5

#: Integers of the kind "medium" are below this in magnitude, so that sums of three fit.
_MEDIUM = 1 << 29


class Functions:
    """What the library offers. All of it may be called from several threads at a time, and leaves the interpreter free.

    Args:
        path: of the library.

    Attributes:
        quantising: those of the encoder that are about splats, and not about integers.
        octree: those about positions. octree_build: those of the encoder.

    Raises:
        OSError: it cannot be loaded.
        AttributeError: one is missing.
    """

    def __init__(self, path: str) -> None:
        self._c = declared(path)
        self.quantising = Quantising(self._c)
        self.octree = OctreeFunctions(self._c)
        self.octree_build = OctreeBuilding(self._c)

    def bundled_file(
        self, splats: int, sections: Mapping[int, SectionWords], steps: ColourSteps | None, vectors: bool = True
    ) -> BundledFile:
        """Sections of coder 4, as :class:`potr_cl.codec.native.bundles.BundledFile` takes them."""
        return BundledFile(self._c, splats, sections, steps, vectors)

    def bundle_share(self, bundles: int) -> BundleShare:
        """So many bundles to decode, as :class:`potr_cl.codec.native.share.BundleShare` takes them."""
        return BundleShare(self._c, bundles)

    def bundle_encoder(self, *integers: Any) -> BundleEncoder:
        """Integers to code, as :class:`potr_cl.codec.native.bundles_encode.BundleEncoder` takes them."""
        return BundleEncoder(self._c, *integers)

    # -------------------------------------------------------------------------------------- context coder

    def context_table(self, frequencies: NDArray[np.integer]) -> U32:
        """What each slot of each context stands for, for :meth:`context_stream`.

        Args:
            frequencies: (contexts, alphabet), at most 32 and 252.

        Returns:
            (contexts · 4096,).

        Raises:
            TypeError: the frequencies of a context do not add up to 4096.
        """
        narrow = np.ascontiguousarray(frequencies, np.uint16)
        contexts, alphabet = narrow.shape
        entries = np.empty(contexts * _TOTAL, np.uint32)
        rows, slots = (
            address(narrow, np.uint16, narrow.size),
            address(entries, np.uint32, len(entries), True),
        )
        if self._c["potr_context_table"](rows, contexts, alphabet, slots):
            raise TypeError("the native path was given frequencies that do not add up")
        return entries

    def context_stream(
        self,
        words: U8,
        read: int,
        states: U32,
        entries: U32,
        contexts: U8,
        size_of: I16,
        known: Sequence[I16],
        weights: I32,
        lane_counts: I64,
        tokens: U8,
        sizes: I16,
    ) -> int | None:
        """Decode one stream.

        Args:
            words: (2 · number,) bytes of 16-bit words.
            read: words that are taken already.
            states: (lanes,), brought up to date.
            entries: as of :meth:`context_table`.
            contexts: (256,) context of each expected size; below the number of contexts of ``entries``.
            size_of: (256,) by token.
            known: up to 5 arrays of sizes (steps, lanes), in the order of the weights.
            weights: (7,).
            lane_counts: (steps,) lanes that have a splat, at most ``lanes``.
            tokens, sizes: (steps, lanes), filled.

        Returns:
            Words that are taken afterwards; None if there are too few.
        """
        steps, lanes = tokens.shape
        if (
            int(contexts.max()) >= len(entries) // _TOTAL
            or int(lane_counts.max()) > lanes
            or int(lane_counts.min()) < 0
        ):
            raise TypeError("the native path was given contexts without entries, or more splats than lanes")
        if len(known) > _CONTEXT_TERMS or not 0 <= read <= len(words) // 2:
            raise TypeError("the native path was given impossible sizes")
        used = np.zeros(_CONTEXT_TERMS + 2, np.int32)
        used[: len(known)] = weights[: len(known)]
        used[_CONTEXT_TERMS:] = weights[_CONTEXT_TERMS:]
        terms = np.zeros(_CONTEXT_TERMS, np.uintp)
        terms[: len(known)] = [address(term, np.int16, steps * lanes) for term in known]
        bases = contexts.astype(np.uint32) * np.uint32(_TOTAL)
        recent = np.empty(lanes, np.int32)
        taken = ctypes.c_size_t(read)
        short = self._c["potr_context_stream"](
            address(words, np.uint8, len(words)),
            len(words) // 2,
            ctypes.byref(taken),
            address(states, np.uint32, lanes, True),
            address(recent, np.int32, lanes, True),
            lanes,
            address(entries, np.uint32, len(entries)),
            address(bases, np.uint32, 256),
            address(size_of, np.int16, 256),
            address(terms, np.uintp, _CONTEXT_TERMS),
            address(used, np.int32, _CONTEXT_TERMS + 2),
            address(lane_counts, np.int64, steps),
            steps,
            address(tokens, np.uint8, steps * lanes, True),
            address(sizes, np.int16, steps * lanes, True),
        )
        return None if short else taken.value

    def bits_beside(self, tokens: U8) -> tuple[int, int]:
        """How many bits stand beside some tokens, all below 252, and the largest token."""
        largest = ctypes.c_uint8()
        bits = self._c["potr_context_beside"](
            address(tokens, np.uint8, tokens.size), tokens.size, ctypes.byref(largest)
        )
        return int(bits), largest.value

    def join_lanes(self, laid: U8) -> U8:
        """(steps, lanes) bytes to (lanes · steps,)."""
        steps, lanes = laid.shape
        joined = np.empty(steps * lanes, np.uint8)
        self._c["potr_context_join"](
            address(laid, np.uint8, laid.size), steps, lanes, address(joined, np.uint8, joined.size, True)
        )
        return joined

    def integers_of_tokens(
        self, tokens: U8, bits: U8, first: int, largest: int, is_signed: bool, predicted: bool
    ) -> NDArray[Any]:
        """The integers of a stream in the order of splats.

        Args:
            tokens: (steps, lanes), below 252.
            bits: bytes of the bits beside tokens.
            first: number of the first bit that belongs to these tokens.
            largest: no integer is beyond this in magnitude, before the prediction is undone.
            is_signed: undo the mapping of signed integers.
            predicted: undo the prediction from the four integers before in the lane.

        Returns:
            (lanes · steps,) int32 or int64.

        Raises:
            TypeError: there are too few bits.
        """
        steps, lanes = tokens.shape
        # A step adds to the largest before it at most that, and what rounding makes of the mean.
        kind = "medium" if (largest + 1) * (steps if predicted else 1) < _MEDIUM else "wide"
        dtype = KINDS[kind]
        values, work = np.empty(steps * lanes, dtype), np.empty(steps * lanes, dtype)
        short = self._c[f"potr_context_integers_{kind}"](
            address(tokens, np.uint8, tokens.size),
            steps,
            lanes,
            address(bits, np.uint8, len(bits)),
            first,
            8 * len(bits),
            is_signed,
            predicted,
            address(work, dtype, work.size, True),
            address(values, dtype, values.size, True),
        )
        if short:
            raise TypeError("the native path was given fewer bits than tokens ask for")
        return values

    def recent_sizes(self, sizes: I32) -> I32:
        """About 8 times the mean size of a lane's last splats, before each; both (streams, steps, lanes)."""
        steps, lanes = sizes.shape[1:]
        recent = np.empty_like(sizes)
        for before, after in zip(sizes, recent, strict=True):
            self._c["potr_encode_recent"](
                address(before, np.int32, steps * lanes), steps, lanes, address(after, np.int32, steps * lanes, True)
            )
        return recent

    def cells(self, terms: Sequence[I32], weights: Sequence[int], constant: int, tokens: U8, alphabet: int) -> U16:
        """(steps, lanes) expected size · alphabet + token.

        Args:
            terms: of the expectation, (steps, lanes) each; weights: one each.
            constant: added to them.
            tokens: (steps, lanes), below the alphabet.
            alphabet: at most 255.
        """
        if len(terms) != len(weights) or not 0 < alphabet < 256 or int(tokens.max()) >= alphabet:
            raise TypeError("the native path was given tokens beyond their alphabet")
        where = np.array([address(term, np.int32, tokens.size) for term in terms], np.uintp)
        factors = np.array([*weights, constant], np.int32)
        cells = np.empty(tokens.shape, np.uint16)
        self._c["potr_encode_cells"](
            address(where, np.uintp, len(terms)),
            len(terms),
            address(factors, np.int32, len(terms) + 1),
            address(tokens, np.uint8, tokens.size),
            tokens.size,
            alphabet,
            address(cells, np.uint16, tokens.size, True),
        )
        return cells

    def count_cells(self, streams: Sequence[U16], size: int) -> I64:
        """(size,) how often each cell occurs in some streams, all below ``size``."""
        counts = np.zeros(size, np.int64)
        for cells in streams:
            self._c["potr_encode_count"](
                address(_below(cells, size), np.uint16, cells.size), cells.size, address(counts, np.int64, size, True)
            )
        return counts

    def encode_stream(self, cells: U16, intervals: U32, states: U32) -> U16:
        """Range code a stream, the last one first.

        Args:
            cells: (steps, lanes), below the length of ``intervals``.
            intervals: of each cell: frequency + 65536 · the sum of those below; frequencies of cells that occur are
                not 0. A lane without a splat has a cell of frequency 4096.
            states: (lanes,), brought up to date.

        Returns:
            The words, in the order in which a decoder takes them.
        """
        steps, lanes = cells.shape
        words = np.empty(cells.size, np.uint16)
        number = self._c["potr_encode_stream"](
            address(_below(cells, len(intervals)), np.uint16, cells.size),
            steps,
            lanes,
            address(intervals, np.uint32, len(intervals)),
            address(states, np.uint32, lanes, True),
            address(words, np.uint16, cells.size, True),
        )
        return words[cells.size - number :]

    # ---------------------------------------------------------------------------------------------- values

    def join_planes(self, raw: U8, planes: int, is_signed: bool) -> NDArray[Any]:
        """Integers of byte planes, as :func:`potr_cl.codec.byte_planes.pack_integers` makes them: int32 or 64 bits."""
        number = len(raw) // planes
        kind = "medium" if planes <= 3 else "wide"
        levels = np.empty(number, np.int32 if kind == "medium" else np.int64 if is_signed else np.uint64)
        self._c[f"potr_join_planes_{kind}"](
            address(raw, np.uint8, number * planes),
            number,
            planes,
            is_signed,
            address(levels, levels.dtype.type, number, True),
        )
        return levels

    def colours(self, levels: Sequence[NDArray[Any]], divisors: F32, out: F32) -> None:
        """Levels of Y, Co, Cg to R, G, B in ``out`` (3, n); ``divisors`` are (n,), or (1,) for all the same."""
        number = out.shape[1]
        kind, alike = self._alike(levels)
        each = len(divisors) != 1
        where = address(divisors, np.float32, number if each else 1)
        red, green, blue = (address(row, np.float32, number, True) for row in out)
        self._c[f"potr_colours_of_{kind}"](*addresses(kind, alike, number), number, where, each, red, green, blue)

    def dc_colours(
        self, residuals: Sequence[NDArray[Any]], classes: I8, steps: I64, inverses: I64, factors: F32, out: F32
    ) -> None:
        """DC from what its prediction has left (:func:`potr_cl.codec.steps.prediction.from_residuals`), as R, G, B.

        Args:
            residuals: of Y, Co, Cg, n each.
            classes: (n,), -32 to 31.
            steps, inverses, factors: (64,) of each class.
            out: (3, n).
        """
        number = out.shape[1]
        kind, alike = self._alike(residuals)
        from_0_on = (classes + np.int8(CLASSES)).view(np.uint8)
        red, green, blue = (address(row, np.float32, number, True) for row in out)
        self._c[f"potr_dc_of_{kind}"](
            *addresses(kind, alike, number),
            number,
            address(from_0_on, np.uint8, number),
            address(steps, np.int64, 2 * CLASSES),
            address(inverses, np.int64, 2 * CLASSES),
            address(factors, np.float32, 2 * CLASSES),
            red,
            green,
            blue,
        )

    def step_classes(self, steps: ColourSteps, scales: I32, opacities: I32) -> tuple[I8, I8]:
        """(N,) classes of the steps of DC, and of AC.

        Args:
            steps: of colours.
            scales: (3, N) levels, 0 to 2^29 - 1.
            opacities: (N,) levels, 0 to 2^29 - 1.
        """
        n = len(opacities)
        for levels in (scales, opacities):
            if int(levels.min(initial=0)) < 0 or int(levels.max(initial=0)) >= _MEDIUM:
                raise TypeError("the native path was given levels that are negative or too large")
        dc, ac = np.empty((2, n), np.int8)
        self._c["potr_steps_classes"](
            ctypes.byref(native_steps(steps, n)),
            address(scales, np.int32, 3 * n),
            address(opacities, np.int32, n),
            n,
            address(dc, np.int8, n, True),
            address(ac, np.int8, n, True),
        )
        return dc, ac

    def look_up(self, levels: NDArray[Any], table: F32, out: F32, column: int) -> int:
        """Values of unsigned levels from a table into a column of ``out`` (n, columns).

        Args:
            levels: (n,).
            table: value of each level from 0 on; at least 256.
            out: levels beyond the table are left as they are.
            column: of ``out``.

        Returns:
            The number of levels beyond the table.
        """
        number, columns = out.shape
        start = address(out, np.float32, out.size, True) + out.itemsize * column
        if not 0 <= column < columns or len(table) < 256:
            raise TypeError("the native path was given a column or a table that is too small")
        kind = kind_of(levels)
        (where,) = addresses(kind, [levels], number)
        values = address(table, np.float32, len(table))
        return int(self._c[f"potr_look_up_{kind}"](where, number, values, len(table), start, columns))

    def rotations(self, levels: Sequence[NDArray[Any]], factors: F32, out: F32) -> None:
        """Levels of x, y, z to quaternions in ``out`` (n, 4); ``factors`` are (n,), or (1,) for all the same."""
        number = len(out)
        kind, alike = self._alike(levels)
        step = 0 if len(factors) == 1 else 1
        where = address(factors, np.float32, number if step else 1)
        self._c[f"potr_rotations_of_{kind}"](
            *addresses(kind, alike, number), number, where, step, address(out, np.float32, 4 * number, True)
        )

    def widened(self, narrow: U8, is_signed: bool) -> I32:
        """Bytes, mapped to unsigned if ``is_signed``, to the integers that they stand for."""
        medium = np.empty(len(narrow), np.int32)
        self._c["potr_widen"](
            address(narrow, np.uint8, len(narrow)),
            len(narrow),
            is_signed,
            address(medium, np.int32, len(narrow), True),
        )
        return medium

    def _alike(self, levels: Sequence[NDArray[Any]]) -> tuple[str, list[NDArray[Any]]]:
        """Signed levels, all of the kind of the widest, and that kind."""
        kind = kind_of(max(levels, key=lambda level: level.itemsize))
        if kind == "narrow":
            return kind, list(levels)
        numbers = [self.widened(level, True) if level.dtype == np.uint8 else level for level in levels]
        return kind, [number.astype(KINDS[kind], copy=False) for number in numbers]


def _below(cells: U16, size: int) -> U16:
    """The cells, if they are below a size."""
    if int(cells.max(initial=0)) >= size:
        raise TypeError("the native path was given cells that are not there")
    return cells
