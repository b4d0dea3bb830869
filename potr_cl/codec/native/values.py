"""Values of bundles as C makes them: where they go (:class:`ValueArrays`, :class:`PackedValues`), what makes them of
levels (:class:`Tables`), and how threads share the bundles out (:class:`BundleShare`).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.steps.rule import CLASSES
from potr_cl.host.threads import Spare
from potr_cl.native.declarations import CFunctions, address

if TYPE_CHECKING:
    from potr_cl.codec.native.bundles import BundledFile

F32 = NDArray[np.float32]

_POINTER, _WORD, _NUMBER = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int32
#: Splats of a bundle.
BUNDLE = 8192
_COEFFICIENTS = 15
#: Columns of values that every splat has, and floats of :class:`PackedValues`.
PACKED_COLUMNS = 11
PACKED = (PACKED_COLUMNS + 4 * _COEFFICIENTS) * BUNDLE


@dataclass(frozen=True)
class ValueArrays:
    """Where the values of n splats of a file go, float32 and contiguous; None for what is not asked for.

    Attributes:
        log_scales: (n, 3).
        quaternions: (n, 4).
        logits: (n,).
        sh: (M, 3, n).
        columns: whether log_scales is (3, n) instead, and quaternions (4, n).
        begin: which splat of the file is the first.
    """

    log_scales: F32 | None = None
    quaternions: F32 | None = None
    logits: F32 | None = None
    sh: F32 | None = None
    columns: bool = False
    begin: int = 0

    def part(self, start: int, stop: int) -> ValueArrays:
        """Those from one splat of the file to another, as views in which a splat is a row."""
        own = slice(start - self.begin, stop - self.begin)
        scales, turned = (self._rows(array, own) for array in (self.log_scales, self.quaternions))
        logits = None if self.logits is None else self.logits[own]
        return ValueArrays(scales, turned, logits, None if self.sh is None else self.sh[:, :, own], begin=start)

    def _rows(self, array: F32 | None, own: slice) -> F32 | None:
        if array is None:
            return None
        return array[:, own].T if self.columns else array[own]


class PackedValues:
    """Memory for the values of a bundle as a device is sent them, in one piece: AC coefficients only that are not 0.

    Args:
        memory: to be taken; None: new memory.

    Attributes:
        memory: (PACKED,) float32: first the values that every splat has, in columns; then the items.
        log_scales, logits: (3, 8192), (8192,), or what stands for them.
        quaternions: (4, 8192).
        dc: (3, 8192) R, G, B.
        items: (15 · 8192, 4) uint32 AC coefficients that are not 0: the coefficient's number (1 to 15) · 8192 and that
            of the splat in the bundle; R, G, B as the bits of float32.
    """

    def __init__(self, memory: F32 | None = None) -> None:
        self.memory = memory = np.empty(PACKED, np.float32) if memory is None else memory
        dense = memory[: PACKED_COLUMNS * BUNDLE].reshape(PACKED_COLUMNS, BUNDLE)
        self.log_scales, self.quaternions, self.logits, self.dc = dense[:3], dense[3:7], dense[7], dense[8:]
        self.items = memory[dense.size :].view(np.uint32).reshape(-1, 4)

    def take(self, values: ValueArrays) -> int:
        """Pack values of at most 8192 splats, in which a splat is a row. Returns the number of items."""
        assert values.log_scales is not None
        assert values.quaternions is not None
        assert values.logits is not None
        assert values.sh is not None
        n = len(values.logits)
        self.log_scales[:, :n], self.quaternions[:, :n] = values.log_scales.T, values.quaternions.T
        self.logits[:n], self.dc[:, :n] = values.logits, values.sh[0]
        coefficients, splats = np.nonzero(values.sh[1:].any(axis=1))
        items = self.items[: len(splats)]
        items[:, 0] = (coefficients + 1) * BUNDLE + splats
        items[:, 1:] = values.sh[coefficients + 1, :, splats].view(np.uint32)
        return len(items)

    @staticmethod
    def used(items: int) -> int:
        """Floats of the memory that hold something, with so many items."""
        return PACKED_COLUMNS * BUNDLE + 4 * items


_rooms = Spare(PackedValues, most=24)


@contextmanager
def packing_rooms(number: int) -> Iterator[list[PackedValues]]:
    """Memory for so many bundles, which the next file gets too."""
    with ExitStack() as stack:
        yield [stack.enter_context(_rooms.taken()) for _ in range(number)]


@dataclass(frozen=True)
class Tables:
    """What makes values of levels.

    Attributes:
        scales, opacities: value of each level from 0 on.
        sf_dc, sf_ac: (64,) scale factors of each class of steps.
        steps, inverses: (64,) int64 of each class of steps, of the prediction of DC.
        sf_rotation: scale factor.
        units: whether quaternions are made as long as 1 in double precision.
    """

    scales: F32
    opacities: F32
    sf_dc: F32
    sf_ac: F32
    steps: NDArray[np.int64]
    inverses: NDArray[np.int64]
    sf_rotation: float
    units: bool = False


class ValuesOfC(ctypes.Structure):
    """What says to C where values go, and how they are made."""

    _fields_ = (
        ("log_scales", _POINTER),
        ("quaternions", _POINTER),
        ("logits", _POINTER),
        ("dc", _POINTER),
        ("ac", _POINTER),
        ("items", _POINTER),
        ("scale_table", _POINTER),
        ("opacity_table", _POINTER),
        ("scale_levels", _WORD),
        ("opacity_levels", _WORD),
        ("sf_dc", _POINTER),
        ("sf_ac", _POINTER),
        ("step", _POINTER),
        ("inverse", _POINTER),
        ("sf_rotation", ctypes.c_float),
        ("coefficients", _NUMBER),
        ("columns", _NUMBER),
        ("units", _NUMBER),
        ("begin", _WORD),
        ("stride", _WORD),
        ("listed", _WORD),
    )


def to_arrays(arrays: ValueArrays, tables: Tables, splats: int, degree: int) -> ValuesOfC:
    """What has C write values to the arrays of all N splats of a file, which must be kept.

    Args:
        arrays: where they go.
        tables: what makes them.
        splats: N.
        degree: of the AC coefficients that are decoded.
    """
    planes = 0 if arrays.sh is None else len(arrays.sh)
    if arrays.begin or (arrays.sh is not None and planes < (degree + 1) ** 2):
        raise TypeError("the native path was given no place for coefficients, or for some splats")
    dc = 0 if arrays.sh is None or not planes else address(arrays.sh, np.float32, planes * 3 * splats, True)
    out = _made_by(tables)
    out.log_scales = _optional(arrays.log_scales, 3 * splats)
    out.quaternions = _optional(arrays.quaternions, 4 * splats)
    out.logits = _optional(arrays.logits, splats)
    out.dc, out.ac = dc or None, dc + 12 * splats if planes > 1 else None
    out.coefficients, out.columns, out.stride = max(planes - 1, 0), arrays.columns, splats
    return out


def to_packed(packed: PackedValues, tables: Tables) -> ValuesOfC:
    """What has C pack the values of a bundle; both must be kept."""
    out = _made_by(tables)
    out.log_scales, out.quaternions, out.logits, out.dc = (
        address(part, np.float32, part.size, True)
        for part in (packed.log_scales, packed.quaternions, packed.logits, packed.dc)
    )
    out.items = address(packed.items, np.uint32, 4 * _COEFFICIENTS * BUNDLE, True)
    out.columns, out.stride = True, BUNDLE
    return out


def _made_by(tables: Tables) -> ValuesOfC:
    return ValuesOfC(
        scale_table=address(tables.scales, np.float32, len(tables.scales)),
        opacity_table=address(tables.opacities, np.float32, len(tables.opacities)),
        scale_levels=len(tables.scales),
        opacity_levels=len(tables.opacities),
        sf_dc=address(tables.sf_dc, np.float32, 2 * CLASSES),
        sf_ac=address(tables.sf_ac, np.float32, 2 * CLASSES),
        step=address(tables.steps, np.int64, 2 * CLASSES),
        inverse=address(tables.inverses, np.int64, 2 * CLASSES),
        sf_rotation=tables.sf_rotation,
        units=tables.units,
    )


def _optional(array: F32 | None, number: int) -> int | None:
    return None if array is None else address(array, np.float32, number, True)


#: Bundles that a thread does before Python may end it.
_AT_A_TIME = 64


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


#: What threads work with: of each the memory, once one of them has asked how much it takes.
_spare: Spare[list[NDArray[np.uint8]]] = Spare(list, most=16)


class BundleShare:
    """The bundles of a file, of which each thread takes the next that nobody has taken.

    Threads may begin before the file is open: they wait for it, and leave the interpreter to others.

    Args:
        c: the library's functions.
        bundles: of the file.
    """

    def __init__(self, c: CFunctions, bundles: int) -> None:
        self._c = c
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
            sections, rotations: what of them, as of :meth:`potr_cl.codec.native.bundles.BundledFile.levels`.
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
        with _spare.taken() as memory:
            size = self._c["potr_bundles_work"]()
            if not memory:
                memory.append(np.empty(size + 64, np.uint8))
            start = -memory[0].ctypes.data % 64
            work = address(memory[0][start : start + size], np.uint8, size, True)
            while self._c["potr_bundles_share"](ctypes.byref(self._share), work, _AT_A_TIME):
                pass

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
            :meth:`potr_cl.codec.native.bundles.BundledFile.levels` does. BEYOND_TABLE: its values are not whole.
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
