"""Bundles that threads decode to values in C: :class:`BundleShare`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.arrays import address
from potr_cl.codec.native.values import PackedValues, Tables, ValueArrays, ValuesOfC, to_arrays, to_packed

if TYPE_CHECKING:
    from potr_cl.codec.native.bundles import BundledFile

_POINTER, _WORD, _NUMBER = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int32
#: Bundles that a thread does before Python may end it.
_AT_A_TIME = 64


#: What threads work with, while nobody has it, and how much of it is kept.
_spare: list[NDArray[np.uint8]] = []
_MOST_SPARE = 16


class _Share(ctypes.Structure):
    _fields_ = (
        ("file", _POINTER),
        ("values", _POINTER),
        ("said", _POINTER),
        ("rooms", _WORD),
        ("bundles", _WORD),
        ("next", _WORD),
        ("limit", _WORD),
        ("end", _WORD),
        ("sections", _NUMBER),
        ("rotating", _NUMBER),
    )


class BundleShare:
    """The bundles of a file, of which each thread takes the next that nobody has taken.

    Threads may begin before the file is open: they wait for it, and leave the interpreter to others.

    Args:
        functions: of the library.
        bundles: of the file.
    """

    def __init__(self, functions: Mapping[str, Any], bundles: int) -> None:
        self._c = functions
        self._said = np.full(bundles, -1, np.int32)
        said = address(self._said, np.int32, bundles, True)
        self._share = _Share(said=said, rooms=1, bundles=bundles, end=bundles)
        self._kept: tuple[Any, ...] = ()

    def open(
        self,
        file: BundledFile,
        sections: int,
        rotations: bool,
        values: ValueArrays | Sequence[PackedValues],
        tables: Tables,
    ) -> None:
        """Let threads decode.

        Args:
            file: that has the bundles.
            sections, rotations: what of them, as of :meth:`potr_cl.codec.native.bundles.BundledFile.integers`.
            values: where it goes: arrays of all splats, or memory for some bundles, which take turns. Then they wait
                until there is room for them (:meth:`allow`).
            tables: what makes values of levels.
        """
        file.check(0, sections, rotations)
        if isinstance(values, ValueArrays):
            places = [to_arrays(values, tables, file.splats, file.degree(sections))]
        elif rotations and sections > 2 and values:
            places = [to_packed(packed, tables) for packed in values]
        else:
            raise TypeError("the native path packs whole splats only, and needs a place for them")
        share, array = self._share, (ValuesOfC * len(places))(*places)
        self._kept = (file, values, tables, array)
        share.file, share.values, share.rooms = ctypes.addressof(file.as_c), ctypes.addressof(array), len(places)
        share.sections, share.rotating = sections, rotations
        share.limit = share.bundles if isinstance(values, ValueArrays) else len(places)

    def do(self) -> None:
        """A thread's share."""
        size = self._c["potr_bundles_work"]()
        try:
            memory = _spare.pop()  # which was written to before, and is there at once
        except IndexError:
            memory = np.empty(size + 64, np.uint8)
        start = -memory.ctypes.data % 64
        work = address(memory[start : start + size], np.uint8, size, True)
        try:
            while self._c["potr_bundles_share"](ctypes.byref(self._share), work, _AT_A_TIME):
                pass
        finally:
            if len(_spare) < _MOST_SPARE:
                _spare.append(memory)

    def allow(self, limit: int) -> None:
        """There is room for the bundles before number ``limit``: what was packed of earlier ones is needed no more."""
        self._share.limit = limit

    def give_up(self) -> None:
        """Have threads end as soon as they can."""
        self._share.end = 0

    def wait(self, bundle: int, look_after: Callable[[], None] = lambda: None) -> tuple[int, int]:
        """Wait until a bundle is done, which some thread does, unless an earlier one is damaged.

        Args:
            bundle: which.
            look_after: called now and then meanwhile; it raises where no thread is left.

        Returns:
            What C says of it, and the section at fault, as
            :meth:`potr_cl.codec.native.bundles.BundledFile.integers` does. BEYOND_TABLE: its values are not whole.
        """
        if not 0 <= bundle < len(self._said):
            raise TypeError("the native path was asked for what is not there")
        said = -1
        while said < 0:
            look_after()
            said = self._c["potr_bundles_wait"](ctypes.byref(self._share), bundle)
        return said & 255, said >> 8

    def items(self, room: int) -> int:
        """How many items were packed last into the memory of this number."""
        values: ValuesOfC = self._kept[3][room]
        return int(values.listed)
