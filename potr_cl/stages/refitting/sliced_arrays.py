"""Arrays with some values a splat, on the device or, where it has no room, on the host: :class:`SlicedArrays`.

What is on the host goes through the device in slices. Where a kernel does one splat after the other, a slice is some
splats, all columns of them. Sums and dot products do one value after the other: there a piece of the array as it lies
in memory is enough. Where all arrays are on the device there is one slice, and nothing is copied. All bits are the
same.

Where memory is bounded, large arrays on the host lie in temporary files (:mod:`potr_cl.host.mapped`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host import mapped
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.scene_buffers import SPLAT_GROUP

#: Y, Co and Cg.
CHANNELS = 3
#: Splats of a work-group.
_GROUP = 64


@dataclass(frozen=True)
class Layout:
    """Where the coefficients of a scene's splats lie on the device (cl/refit/coefficients.clh).

    Attributes:
        splats: N. stride: N padded; a column has so many values.
        sh_count: M, coefficients of a channel.
        lanes: splats a work-item.
    """

    splats: int
    stride: int
    sh_count: int
    lanes: int

    @property
    def columns(self) -> int:
        """Coefficients of a splat; coefficient m, channel c of Y, Co, Cg is in column 3 m + c."""
        return 3 * self.sh_count

    @property
    def triangle(self) -> int:
        """Values of a splat's own block of the normal equations, M (M + 1) / 2: its upper triangle, row by row."""
        return self.sh_count * (self.sh_count + 1) // 2

    @property
    def macros(self) -> dict[str, int]:
        """What the kernels must know of it when they are built."""
        return {"LANES": self.lanes, "SH_COUNT": self.sh_count}

    def some(self, constant: bool) -> dict[str, int]:
        """The same for kernels that look at all coefficients, or at the constant ones, whose columns come first."""
        return {**self.macros, "SH_COUNT": 1} if constant else self.macros

    def items(self, stride: int, *others: int, group: int = _GROUP) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Work-items, and those of a group, for so many splats, and in the second dimension for ``others``."""
        return (stride // self.lanes, *others), (max(group // self.lanes, 1), *(1 for _ in others))


@dataclass(frozen=True)
class Ridge:
    """The penalty beside the pictures' error: lam |x_AC|^2 + prior |x - start|^2, with a larger lam on chroma.

    Attributes:
        lam: on the AC coefficients of Y, in pixels of an image of ``REFERENCE_PIXELS``.
        chroma_factor: lambda of Co and Cg over that of Y.
        prior: on every coefficient's distance to its start, in the same unit.
    """

    lam: float
    chroma_factor: float
    prior: float

    @property
    def scalars(self) -> dict[str, np.float32]:
        """The arguments of that name of the kernels."""
        return {
            "lambda_luma": np.float32(self.lam),
            "lambda_chroma": np.float32(self.lam * self.chroma_factor),
            "prior": np.float32(self.prior),
        }


#: Work-items that share a dot product: the sums of one piece go on where those of the piece before end.
DOT_ITEMS = 16384
#: Bytes of rows that are on the device at a time while integers are added to them, about.
_ROWS = 1 << 26


@dataclass(eq=False)
class HostArray:
    """Columns of four bytes a splat in the host's memory.

    Attributes:
        values: (columns, stride).
        zero: they stand for zeros, whatever they are.
        changes: how often they have changed.
    """

    values: FloatArray
    zero: bool = True
    changes: int = 0

    def changed(self, zero: bool = False) -> None:
        """Note that they are no longer what they were."""
        self.zero = zero
        self.changes += 1


#: (columns, stride) of four bytes, on the host or the device.
Array: TypeAlias = "HostArray | cl.Buffer"


@dataclass(frozen=True)
class Slice:
    """Some splats of some arrays, on the device.

    Attributes:
        splats: which ones.
        stride: values of a column there.
        layout: of the whole arrays.
        buffers: of each array.
    """

    splats: range
    stride: int
    layout: Layout
    buffers: dict[Array, cl.Buffer]

    def __getitem__(self, array: Array) -> cl.Buffer:
        return self.buffers[array]

    def run(self, kernel: Kernel, *others: int, **group: int) -> None:
        """Launch a bound kernel over the splats, with work-items as :meth:`.layout.Layout.items` has them."""
        kernel.launch(*self.layout.items(len(self.splats), *others, **group))


class SlicedArrays(Owner):
    """The arrays of one scene.

    Args:
        device: to compute on.
        layout: of the coefficients.
        splats: of a slice; None: all, and all arrays are on the device.

    Attributes:
        device, layout: as given.
    """

    def __init__(self, device: Device, layout: Layout, splats: int | None = None) -> None:
        self.device, self.layout = device, layout
        self.whole = splats is None
        self._splats = min(-(-(splats or layout.stride) // SPLAT_GROUP) * SPLAT_GROUP, layout.stride)
        self._piece = -(-self._splats * layout.columns // DOT_ITEMS) * DOT_ITEMS
        self._memory = Memory(device)
        self._ferry = Ferry(device)
        #: Where slices lie: by their columns, and how many of the same columns are there before.
        self._places: dict[tuple[int, int], cl.Buffer] = {}
        self._from_fixed = device.shared_kernel(
            "refit/gather.cl", "from_fixed", WEIGHTS=0, SOME_BLOCKS=0, **layout.macros
        )

    # ------------------------------------------------------------------------------------------ arrays

    def array(self, columns: int, what: str, on_device: bool = False) -> Array:
        """A new array, on the device if it is to be there or all are; it is given back by :meth:`close`.

        Raises:
            PotrError: the host has no room. DeviceError: the device has none.
        """
        if self.whole or on_device:
            return self._memory.allocate(4 * columns * self.layout.stride, what)
        return HostArray(mapped.array((columns, self.layout.stride), np.float32, what))

    def holding(self, memory: Memory, values: NDArray[Any], what: str) -> Array:
        """An array of one column that holds (stride,) values of four bytes; on the device, memory owns it."""
        if self.whole:
            return memory.upload(values, what)
        return HostArray(values.view(np.float32)[None], zero=False)

    def zero(self, x: Array) -> None:
        """x = 0."""
        if isinstance(x, HostArray):
            x.changed(zero=True)
        else:
            self.device.fill(x, np.float32(0))

    def copy(self, y: Array, x: Array) -> None:
        """y = x."""
        if isinstance(y, HostArray):
            y.changed(zero=isinstance(x, HostArray) and x.zero)
            if not isinstance(x, HostArray):
                self._ferry.to_host([Cargo(y.values.reshape(-1))], x)
            elif not x.zero:
                np.copyto(y.values, x.values)
        elif isinstance(x, HostArray):
            self._to_device(x, y)
        else:
            self.device.copy(y, x)

    def _to_device(self, x: HostArray, buffer: cl.Buffer, first: int = 0, count: int | None = None) -> None:
        if x.zero:
            self.device.fill(buffer, np.float32(0))
        else:
            self._ferry.to_device(buffer, [Cargo(x.values.reshape(-1)[first:][:count])])

    def read(self, x: Array, rows: range | None = None) -> FloatArray:
        """(columns, N) float32, all columns or some that follow each other."""
        rows = range(self.columns_of(x)) if rows is None else rows
        stride, splats = self.layout.stride, self.layout.splats
        if isinstance(x, HostArray):
            return np.zeros((len(rows), splats), np.float32) if x.zero else x.values[rows.start : rows.stop, :splats]
        shape = (len(rows), stride)
        return self.device.download(x, shape, np.float32, 4 * stride * rows.start)[:, :splats]

    def write(self, x: Array, values: NDArray[np.floating]) -> None:
        """Set an array from (columns, N); what pads them becomes 0."""
        self.zero(x)
        values = np.ascontiguousarray(values, np.float32)
        if isinstance(x, HostArray):
            x.values[:] = 0
            x.values[:, : values.shape[1]] = values
            x.changed()
        else:
            self._ferry.to_device(x, [Cargo(values, columns=range(values.shape[1]))], pitch=4 * self.layout.stride)

    def columns_of(self, x: Array) -> int:
        """How many columns an array has."""
        return len(x.values) if isinstance(x, HostArray) else int(x.size) // (4 * self.layout.stride)

    # ------------------------------------------------------------------------------------------ slices and pieces

    def slices(self, read: Sequence[Array] = (), written: Sequence[Array] = ()) -> Iterator[Slice]:
        """Go over the splats.

        Args:
            read: arrays whose slices are to be on the device.
            written: arrays, perhaps the same, that take what their slices have become.
        """
        arrays = dict.fromkeys([*read, *written])
        stride = self.layout.stride
        if self.whole:
            yield Slice(range(stride), stride, self.layout, {x: x for x in arrays})
            return
        buffers: dict[Array, cl.Buffer] = {}
        before: dict[int, int] = {}
        for x in arrays:
            columns = self.columns_of(x)
            place = before[columns] = before.get(columns, -1) + 1
            buffers[x] = self._place(columns, place)
        for first in range(0, stride, self._splats):
            part = Slice(range(first, min(first + self._splats, stride)), self._splats, self.layout, buffers)
            for x in read:
                self._rectangle(x, part, to_slice=True)
            yield part
            for x in written:
                self._rectangle(x, part, to_slice=False)
        for x in written:
            _changed(x)

    def pieces(
        self, *arrays: Array, count: int | None = None, written: bool = False
    ) -> Iterator[tuple[int, int, list[cl.Buffer]]]:
        """Go over the values as they lie in memory: the first one of a piece, their number, and the arrays' pieces.

        Args:
            arrays: one or two with as many columns as vectors of coefficients have.
            count: of the values; None: all.
            written: the first array takes what its pieces have become.
        """
        count = self.length if count is None else count
        if not any(isinstance(x, HostArray) for x in arrays):
            yield 0, count, list(arrays)
            return
        for first in range(0, count, self._piece):
            some = min(self._piece, count - first)
            buffers = [self._piece_of(x, place, first, some) for place, x in enumerate(dict.fromkeys(arrays))]
            yield first, some, [buffers[0], buffers[-1]][: len(arrays)]
            if written and isinstance(arrays[0], HostArray):
                self._ferry.to_host([Cargo(arrays[0].values.reshape(-1)[first : first + some])], buffers[0])
            elif written:
                self.device.copy(arrays[0], buffers[0], 4 * some, to=4 * first)
        if written:
            _changed(arrays[0])

    @property
    def length(self) -> int:
        """Values of a vector of coefficients, padding included."""
        return self.layout.columns * self.layout.stride

    def _piece_of(self, x: Array, place: int, first: int, count: int) -> cl.Buffer:
        buffer = self._place(self.layout.columns, place)
        if isinstance(x, HostArray):
            self._to_device(x, buffer, first, count)
        else:
            # Not a part of the buffer: NVIDIA's driver carries these to the host and back.
            self.device.copy(buffer, x, 4 * count, of=4 * first)
        return buffer

    def _place(self, columns: int, number: int) -> cl.Buffer:
        if (columns, number) not in self._places:
            values = max(columns * self._splats, self._piece if columns == self.layout.columns else 0)
            self._places[columns, number] = self._memory.allocate(4 * values, "a slice of the SH coefficients")
        return self._places[columns, number]

    def _rectangle(self, x: Array, part: Slice, to_slice: bool) -> None:
        """Copy some splats of all columns to where their slice lies, or from there."""
        buffer, splats = part[x], part.splats
        if isinstance(x, HostArray):
            if not to_slice:
                self.to_host(x.values, splats, buffer, part.stride)
            elif x.zero:
                self.device.fill(buffer, np.float32(0))
            else:
                self.to_device(buffer, part.stride, x.values, splats)
            return
        whole, some = ((4 * splats.start, 0, 0), (4 * self.layout.stride, 0)), ((0, 0, 0), (4 * part.stride, 0))
        source, target = (whole, some) if to_slice else (some, whole)
        with self.device.errors("failed while computing"):
            cl.enqueue_copy(
                self.device.queue,
                *((buffer, x) if to_slice else (x, buffer)),
                src_origin=source[0],
                dst_origin=target[0],
                region=(4 * len(splats), self.columns_of(x), 1),
                src_pitches=source[1],
                dst_pitches=target[1],
            )

    def to_host(self, values: FloatArray, splats: range, buffer: cl.Buffer, stride: int) -> None:
        """Copy what is of some splats to a matrix on the host, from columns of so many values each."""
        self._ferry.to_host([Cargo(values, columns=splats)], buffer, pitch=4 * stride)

    def to_device(self, buffer: cl.Buffer, stride: int, values: FloatArray, splats: range) -> None:
        """The same the other way round."""
        self._ferry.to_device(buffer, [Cargo(values, columns=splats)], pitch=4 * stride)

    # ------------------------------------------------------------------------------------------ sums

    def add_sums(self, x: Array, sums: cl.Buffer, unit: float, constant: bool = False) -> None:
        """x += unit times integers, which become 0.

        Args:
            x: with as many columns as vectors have.
            sums: (columns, stride) int64 in the device's memory.
            unit: in single precision.
            constant: only the constant coefficients' columns, which come first; all other sums are 0.
        """
        # Of zeros all are written: they only stand for them.
        count = 3 * self.layout.stride if constant and not (isinstance(x, HostArray) and x.zero) else None
        for first, some, (piece,) in self.pieces(x, count=count, written=True):
            self._add_fixed(piece, sums, first, some, unit)

    def set_sums(self, x: Array, sums: cl.Buffer, unit: float, splats: range) -> None:
        """x = unit times integers, which become 0, for some splats.

        Args:
            x: of any number of columns.
            sums: (columns, len(splats)) int64 in the device's memory; of all splats, where x is there.
            unit: in single precision.
            splats: which ones.
        """
        columns = self.columns_of(x)
        if not isinstance(x, HostArray):
            self.zero(x)
            self._add_fixed(x, sums, 0, columns * len(splats), unit)
            return
        some = min(max(_ROWS // (4 * len(splats)), 1), columns)
        with Memory(self.device) as memory:
            buffer = memory.allocate(4 * len(splats) * some, "sums of splats")
            for row in range(0, columns, some):
                rows = x.values[row : row + some]
                self.zero(buffer)
                self._add_fixed(buffer, sums, row * len(splats), len(rows) * len(splats), unit)
                self.to_host(rows, splats, buffer, len(splats))
        x.changed()

    def _add_fixed(self, result: cl.Buffer, sums: cl.Buffer, first: int, count: int, unit: float) -> None:
        self._from_fixed.bind(sums=sums, first=first, unit=np.float32(unit), result=result).launch((count,))

    def close(self) -> None:
        """Give all device memory back; files on the host go with their arrays."""
        self._places = {}
        self._ferry.close()
        self._memory.close()


def _changed(x: Array) -> None:
    if isinstance(x, HostArray):
        x.changed()
