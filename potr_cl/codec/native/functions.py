"""The C functions for NumPy arrays: :class:`Functions`.

C trusts the sizes that it is told. They are read off the arrays here, and arrays of another type, shape or layout than
a function takes are refused before it is called.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]

_TOTAL = 4096  # what a context's frequencies add up to
_CONTEXT_TERMS = 5
_LEVELS = 53  # of an octree, and lengths of tails
_TREE_WORDS = 2 * (_LEVELS + 1)

_SIZE, _NUMBER, _POINTER, _WORD = ctypes.c_size_t, ctypes.c_int, ctypes.c_void_p, ctypes.c_uint64
_REAL = ctypes.c_float

#: Argument types and result of each function, in the order of the C declarations.
_DECLARATIONS: dict[str, tuple[Any, list[Any]]] = {
    "potr_context_table": (_NUMBER, [_POINTER, _SIZE, _SIZE, _POINTER]),
    "potr_context_stream": (
        _NUMBER,
        [_POINTER, _SIZE, *[_POINTER] * 3, _SIZE, *[_POINTER] * 6, _SIZE, _POINTER, _POINTER],
    ),
    "potr_context_beside": (_WORD, [_POINTER, _SIZE, _POINTER]),
    "potr_context_join": (None, [_POINTER, _SIZE, _SIZE, _POINTER]),
    "potr_octree_levels": (
        _NUMBER,
        [_POINTER, _SIZE, _POINTER, _SIZE, _NUMBER, _NUMBER, _POINTER, _POINTER, _POINTER],
    ),
    "potr_octree_tails": (
        _NUMBER,
        [_POINTER, _SIZE, _POINTER, _NUMBER, _POINTER, _POINTER, _WORD, _WORD, _NUMBER, _POINTER],
    ),
    "potr_octree_centres": (
        _NUMBER,
        [_POINTER, _SIZE, _POINTER, _NUMBER, _POINTER, _POINTER, _WORD, _WORD, _NUMBER, *[_POINTER] * 6, _WORD],
    ),
    "potr_encode_recent": (None, [_POINTER, _SIZE, _SIZE, _POINTER]),
    "potr_encode_cells": (None, [_POINTER, _SIZE, _POINTER, _POINTER, _SIZE, ctypes.c_int32, _POINTER]),
    "potr_encode_count": (None, [_POINTER, _SIZE, _POINTER]),
    "potr_encode_stream": (_SIZE, [_POINTER, _SIZE, _SIZE, _POINTER, _POINTER, _POINTER]),
    "potr_widen": (None, [_POINTER, _SIZE, _NUMBER, _POINTER]),
}
#: Those that there are for several kinds of integers, by what their names begin with.
_OF_KINDS: dict[str, tuple[Any, list[Any], tuple[str, ...]]] = {
    "potr_context_integers_": (
        _NUMBER,
        [_POINTER, _SIZE, _SIZE, _POINTER, _WORD, _WORD, _NUMBER, _NUMBER, _POINTER, _POINTER],
        ("medium", "wide"),
    ),
    "potr_join_planes_": (None, [_POINTER, _SIZE, ctypes.c_uint, _NUMBER, _POINTER], ("medium", "wide")),
    "potr_colours_of_": (
        None,
        [_POINTER, _POINTER, _POINTER, _SIZE, _REAL, _POINTER, _POINTER, _POINTER],
        ("narrow", "medium", "wide"),
    ),
    "potr_look_up_": (_WORD, [_POINTER, _SIZE, _POINTER, _SIZE, _POINTER, _SIZE], ("narrow", "medium", "wide")),
    "potr_rotations_of_": (
        None,
        [_POINTER, _POINTER, _POINTER, _SIZE, _POINTER, _SIZE, _POINTER],
        ("narrow", "medium", "wide"),
    ),
}
#: What integers of each kind are stored as; those of 64 bits may be unsigned.
_KINDS: dict[str, type[np.generic]] = {"narrow": np.uint8, "medium": np.int32, "wide": np.int64}
#: Integers of the kind "medium" are below this in magnitude, so that sums of three fit.
_MEDIUM = 1 << 29


def _address(array: NDArray[Any], dtype: type[np.generic], number: int, writable: bool = False) -> int:
    """Where an array's numbers are, once it is sure that they are as many, of that type, and one after another."""
    if array.dtype != dtype or array.size != number or not array.flags.c_contiguous or not array.flags.aligned:
        raise TypeError(f"the native path takes {number} of {np.dtype(dtype)}, not {array.size} of {array.dtype}")
    if writable and not array.flags.writeable:
        raise TypeError("the native path cannot write to a read-only array")
    return array.ctypes.data


@dataclass(frozen=True)
class Tree:
    """A tree that was found to be sound, by :meth:`Functions.octree_levels`.

    Attributes:
        levels: where its levels begin, for the functions that follow.
        singles, crowded: leaves with a lone splat, and with several.
    """

    levels: U64
    singles: int
    crowded: int


class Functions:
    """What the library offers. All of it may be called from several threads at a time, and leaves the interpreter free.

    Args:
        library: to take the functions from.

    Raises:
        AttributeError: one is missing.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        self._c: dict[str, Any] = {}
        for name, (result, arguments) in _DECLARATIONS.items():
            function = library[name]
            function.restype, function.argtypes = result, arguments
            self._c[name] = function
        for start, (result, arguments, kinds) in _OF_KINDS.items():
            for kind in kinds:
                function = library[start + kind]
                function.restype, function.argtypes = result, arguments
                self._c[start + kind] = function

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
            _address(narrow, np.uint16, narrow.size),
            _address(entries, np.uint32, len(entries), True),
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
        terms[: len(known)] = [_address(term, np.int16, steps * lanes) for term in known]
        bases = contexts.astype(np.uint32) * np.uint32(_TOTAL)
        recent = np.empty(lanes, np.int32)
        taken = ctypes.c_size_t(read)
        short = self._c["potr_context_stream"](
            _address(words, np.uint8, len(words)),
            len(words) // 2,
            ctypes.byref(taken),
            _address(states, np.uint32, lanes, True),
            _address(recent, np.int32, lanes, True),
            lanes,
            _address(entries, np.uint32, len(entries)),
            _address(bases, np.uint32, 256),
            _address(size_of, np.int16, 256),
            _address(terms, np.uintp, _CONTEXT_TERMS),
            _address(used, np.int32, _CONTEXT_TERMS + 2),
            _address(lane_counts, np.int64, steps),
            steps,
            _address(tokens, np.uint8, steps * lanes, True),
            _address(sizes, np.int16, steps * lanes, True),
        )
        return None if short else taken.value

    def bits_beside(self, tokens: U8) -> tuple[int, int]:
        """How many bits stand beside some tokens, all below 252, and the largest token."""
        largest = ctypes.c_uint8()
        bits = self._c["potr_context_beside"](
            _address(tokens, np.uint8, tokens.size), tokens.size, ctypes.byref(largest)
        )
        return int(bits), largest.value

    def join_lanes(self, laid: U8) -> U8:
        """(steps, lanes) bytes to (lanes · steps,)."""
        steps, lanes = laid.shape
        joined = np.empty(steps * lanes, np.uint8)
        self._c["potr_context_join"](
            _address(laid, np.uint8, laid.size), steps, lanes, _address(joined, np.uint8, joined.size, True)
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
        dtype = _KINDS[kind]
        values, work = np.empty(steps * lanes, dtype), np.empty(steps * lanes, dtype)
        short = self._c[f"potr_context_integers_{kind}"](
            _address(tokens, np.uint8, tokens.size),
            steps,
            lanes,
            _address(bits, np.uint8, len(bits)),
            first,
            8 * len(bits),
            is_signed,
            predicted,
            _address(work, dtype, work.size, True),
            _address(values, dtype, values.size, True),
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
                _address(before, np.int32, steps * lanes), steps, lanes, _address(after, np.int32, steps * lanes, True)
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
        where = np.array([_address(term, np.int32, tokens.size) for term in terms], np.uintp)
        factors = np.array([*weights, constant], np.int32)
        cells = np.empty(tokens.shape, np.uint16)
        self._c["potr_encode_cells"](
            _address(where, np.uintp, len(terms)),
            len(terms),
            _address(factors, np.int32, len(terms) + 1),
            _address(tokens, np.uint8, tokens.size),
            tokens.size,
            alphabet,
            _address(cells, np.uint16, tokens.size, True),
        )
        return cells

    def count_cells(self, streams: Sequence[U16], size: int) -> I64:
        """(size,) how often each cell occurs in some streams, all below ``size``."""
        counts = np.zeros(size, np.int64)
        for cells in streams:
            self._c["potr_encode_count"](
                _address(_below(cells, size), np.uint16, cells.size), cells.size, _address(counts, np.int64, size, True)
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
            _address(_below(cells, len(intervals)), np.uint16, cells.size),
            steps,
            lanes,
            _address(intervals, np.uint32, len(intervals)),
            _address(states, np.uint32, lanes, True),
            _address(words, np.uint16, cells.size, True),
        )
        return words[cells.size - number :]

    # ---------------------------------------------------------------------------------------------- octree

    def octree_levels(self, occupancy: U8, several: U8, depth: int, crowded_root: bool) -> Tree | None:
        """Check a tree; None if its streams contradict each other. ``depth`` is 0 to 52."""
        levels = np.empty(_TREE_WORDS, np.uint64)
        singles, crowded = ctypes.c_uint64(), ctypes.c_uint64()
        wrong = self._c["potr_octree_levels"](
            _address(occupancy, np.uint8, len(occupancy)),
            len(occupancy),
            _address(several, np.uint8, len(several)),
            len(several),
            depth,
            crowded_root,
            _address(levels, np.uint64, _TREE_WORDS, True),
            ctypes.byref(singles),
            ctypes.byref(crowded),
        )
        return None if wrong else Tree(levels, singles.value, crowded.value)

    def octree_tails(
        self, occupancy: U8, several: U8, depth: int, tree: Tree, tail_lengths: U8, absolute: bool
    ) -> U64 | None:
        """(53,) leaves with a tail of each length; None if one leads below ``depth``."""
        counts = np.empty(_LEVELS, np.uint64)
        wrong = self._c["potr_octree_tails"](
            _address(occupancy, np.uint8, len(occupancy)),
            len(occupancy),
            _address(several, np.uint8, len(several)),
            depth,
            _address(tree.levels, np.uint64, _TREE_WORDS),
            _address(tail_lengths, np.uint8, tree.singles),
            tree.singles,
            tree.crowded,
            absolute,
            _address(counts, np.uint64, _LEVELS, True),
        )
        return None if wrong else counts

    def octree_centres(
        self,
        occupancy: U8,
        several: U8,
        depth: int,
        tree: Tree,
        tail_lengths: U8,
        absolute: bool,
        counts: U64,
        multiplicities: U64,
        tails: U8,
        sides: F64,
        origin: F64,
        means: F32,
    ) -> int:
        """Centres of all splats into ``means`` (splats, 3).

        Returns:
            0; 1 if the padding of a plane of ``tails`` is not zero; 2 if there are not as many splats.
        """
        reach = np.cumsum(counts[::-1].astype(np.int64))[::-1][1:]
        if len(tails) != int((3 * ((reach + 7) // 8)).sum()) or int(counts.sum()) != tree.singles:
            raise TypeError("the native path was given tails of another size than their lengths ask for")
        return int(
            self._c["potr_octree_centres"](
                _address(occupancy, np.uint8, len(occupancy)),
                len(occupancy),
                _address(several, np.uint8, len(several)),
                depth,
                _address(tree.levels, np.uint64, _TREE_WORDS),
                _address(tail_lengths, np.uint8, tree.singles),
                tree.singles,
                tree.crowded,
                absolute,
                _address(counts, np.uint64, _LEVELS),
                _address(multiplicities, np.uint64, tree.crowded),
                _address(tails, np.uint8, len(tails)),
                _address(sides, np.float64, depth + 1),
                _address(origin, np.float64, 3),
                _address(means, np.float32, 3 * len(means), True),
                len(means),
            )
        )

    # ---------------------------------------------------------------------------------------------- values

    def join_planes(self, raw: U8, planes: int, is_signed: bool) -> NDArray[Any]:
        """Integers of byte planes, as :func:`potr_cl.codec.byte_planes.pack_integers` makes them: int32 or 64 bits."""
        number = len(raw) // planes
        kind = "medium" if planes <= 3 else "wide"
        levels = np.empty(number, np.int32 if kind == "medium" else np.int64 if is_signed else np.uint64)
        self._c[f"potr_join_planes_{kind}"](
            _address(raw, np.uint8, number * planes),
            number,
            planes,
            is_signed,
            _address(levels, levels.dtype.type, number, True),
        )
        return levels

    def colours(self, levels: Sequence[NDArray[Any]], divisor: float, out: F32) -> None:
        """Levels of Y, Co, Cg to R, G, B in ``out`` (3, n)."""
        number = out.shape[1]
        kind, alike = self._alike(levels)
        red, green, blue = (_address(row, np.float32, number, True) for row in out)
        self._c[f"potr_colours_of_{kind}"](*_addresses(kind, alike, number), number, divisor, red, green, blue)

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
        start = _address(out, np.float32, out.size, True) + out.itemsize * column
        if not 0 <= column < columns or len(table) < 256:
            raise TypeError("the native path was given a column or a table that is too small")
        kind = _kind(levels)
        (where,) = _addresses(kind, [levels], number)
        values = _address(table, np.float32, len(table))
        return int(self._c[f"potr_look_up_{kind}"](where, number, values, len(table), start, columns))

    def rotations(self, levels: Sequence[NDArray[Any]], factors: F32, out: F32) -> None:
        """Levels of x, y, z to quaternions in ``out`` (n, 4); ``factors`` are (n,), or (1,) for all the same."""
        number = len(out)
        kind, alike = self._alike(levels)
        step = 0 if len(factors) == 1 else 1
        where = _address(factors, np.float32, number if step else 1)
        self._c[f"potr_rotations_of_{kind}"](
            *_addresses(kind, alike, number), number, where, step, _address(out, np.float32, 4 * number, True)
        )

    def widened(self, narrow: U8, is_signed: bool) -> I32:
        """Bytes, mapped to unsigned if ``is_signed``, to the integers that they stand for."""
        medium = np.empty(len(narrow), np.int32)
        self._c["potr_widen"](
            _address(narrow, np.uint8, len(narrow)),
            len(narrow),
            is_signed,
            _address(medium, np.int32, len(narrow), True),
        )
        return medium

    def _alike(self, levels: Sequence[NDArray[Any]]) -> tuple[str, list[NDArray[Any]]]:
        """Signed levels, all of the kind of the widest, and that kind."""
        kind = _kind(max(levels, key=lambda level: level.itemsize))
        if kind == "narrow":
            return kind, list(levels)
        numbers = [self.widened(level, True) if level.dtype == np.uint8 else level for level in levels]
        return kind, [number.astype(_KINDS[kind], copy=False) for number in numbers]


def _below(cells: U16, size: int) -> U16:
    """The cells, if they are below a size."""
    if int(cells.max(initial=0)) >= size:
        raise TypeError("the native path was given cells that are not there")
    return cells


def _kind(levels: NDArray[Any]) -> str:
    return {1: "narrow", 4: "medium", 8: "wide"}[levels.itemsize]


def _addresses(kind: str, levels: Sequence[NDArray[Any]], number: int) -> list[int]:
    """Of levels of one kind; int64 and uint64 are the same to C, where sums wrap round."""
    dtype = _KINDS[kind]
    return [_address(level.view(dtype) if kind == "wide" else level, dtype, number) for level in levels]
