"""Vectors of SH coefficients in the host's memory: :class:`SlicedCoefficients`.

What a device has no room for goes through it in slices. Where a kernel does one splat after the other, a slice is some
splats, all columns of them. Sums and dot products do one value after the other: there a slice is a piece of the vector
as it lies in memory, and each is added to where the slice before it left the sums. So all bits are those of vectors in
the device's memory.

Where memory is bounded, large vectors lie in temporary files (:mod:`potr_cl.host.mapped`): the system may write to the
disk what is not in use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host import mapped
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.memory import Memory
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.stages.refitting.coefficients import DOT_ITEMS, Coefficients
from potr_cl.stages.refitting.vector_space import RARELY, Layout, Ridge, VectorSpace

#: Vectors of which a slice is on the device at a time, and vectors that are there whole to be read.
_SLICES, _OPERANDS = 2, 2


@dataclass
class HostColumns:
    """Columns of float32, one value a splat, in the host's memory.

    Attributes:
        values: (columns, stride).
        zero: they stand for zeros, whatever they are.
        changes: how often they have changed.
    """

    values: FloatArray
    zero: bool = True
    changes: int = 0

    def changed(self) -> None:
        """Note that they are no longer what they were, nor zeros."""
        self.zero = False
        self.changes += 1


#: A vector on the host, or one on the device.
AnyVector: TypeAlias = "HostColumns | cl.Buffer"


class SlicedCoefficients(VectorSpace):
    """A :class:`potr_cl.stages.refitting.vector_space.VectorSpace` whose vectors are mostly :class:`HostColumns`.

    Args:
        device: to compute on.
        layout: of the vectors.
        splats: of a slice.
        resident: vectors of a lower rank than this lie on the device.

    Attributes:
        own: the slice's vectors and flags on the device.
        ferry: takes what goes between the host and the device.

    Raises:
        PotrError: there is no room for the vectors.
        DeviceError: the device has no room for a slice, or the kernels cannot be built.
    """

    def __init__(self, device: Device, layout: Layout, splats: int, resident: int = 0) -> None:
        super().__init__(device, layout)
        self._splats = min(-(-splats // SPLAT_GROUP) * SPLAT_GROUP, layout.stride)
        #: Values of a piece of a vector; the sums of a dot product go on after a multiple of their items.
        self._piece = -(-self._splats * layout.columns // DOT_ITEMS) * DOT_ITEMS
        self._resident = resident
        self._memory = Memory(device)
        self.ferry = Ferry(device)
        self._operands: list[cl.Buffer | None] = [None] * _OPERANDS
        self._held: list[tuple[HostColumns, int] | None] = [None] * _OPERANDS
        with device.all_or_nothing():
            self.own = Coefficients(device, Layout(self._splats, self._splats, layout.sh_count, layout.lanes))
            self._active = self._memory.allocate(8 * layout.stride, "the coefficients that may change")
            self._slices = [self._memory.allocate(4 * self._piece, "the SH coefficients") for _ in range(_SLICES)]
        self.activate(None)

    # ------------------------------------------------------------------------------------------ vectors

    def columns(self, number: int, what: str) -> HostColumns:
        """So many new columns that stand for zeros."""
        return HostColumns(mapped.array((number, self.layout.stride), np.float32, what))

    def vector(self, rank: int = RARELY) -> HostColumns | cl.Buffer:
        """See :meth:`VectorSpace.vector`. Those that are used most often lie on the device after all."""
        if rank < self._resident:
            return self._memory.allocate(4 * self.length, "the SH coefficients")
        return self.columns(self.layout.columns, "SH coefficients")

    def zero(self, x: AnyVector) -> None:
        """x = 0."""
        if isinstance(x, HostColumns):
            x.changed()
            x.zero = True
        else:
            self.clear(x)

    def copy(self, y: AnyVector, x: AnyVector) -> None:
        """y = x."""
        if isinstance(y, HostColumns) and isinstance(x, HostColumns):
            y.changed()
            y.zero = x.zero
            if not x.zero:
                np.copyto(y.values, x.values)
            return
        for first, count in self._pieces():
            self._take_piece(y, self._piece_of(x, 0, first, count), first, count)
        _changed(y)

    def combine(self, a: float, y: AnyVector, b: float, x: AnyVector) -> None:
        """y = a y + b x."""
        if not (isinstance(y, HostColumns) or isinstance(x, HostColumns)):
            self.own.combine_some(a, y, b, x, self.length)
            return
        for first, count in self._pieces():
            some = self._piece_of(y, 0, first, count)
            self.own.combine_some(a, some, b, self._piece_of(x, 1, first, count), count)
            self._take_piece(y, some, first, count)
        _changed(y)

    def dot(self, x: AnyVector, y: AnyVector) -> float:
        """x · y; waits for the device. Not finite where single precision overflows."""
        return self._dot(x, y)[0]

    def largest(self, x: AnyVector) -> float:
        """The largest |x_i|; waits for the device."""
        return self._dot(x, x)[1]

    def _dot(self, x: AnyVector, y: AnyVector) -> tuple[float, float]:
        if not (isinstance(x, HostColumns) or isinstance(y, HostColumns)):
            self.own.begin_dot(x, y, self.length)
            return self.own.found_dot()
        for first, count in self._pieces():
            one = self._piece_of(x, 0, first, count)
            other = one if y is x else self._piece_of(y, 1, first, count)
            self.own.begin_dot(one, other, count, more=first > 0)
        return self.own.found_dot()

    def add_ridge(self, sums: AnyVector, x: AnyVector, ridge: Ridge) -> None:
        """sums += (lam on AC + prior) x on the active coefficients; the others' sums become 0."""
        for part in self.parts():
            self.give_flags(part)
            some = self.give(sums, part, 0)
            self.own.add_ridge(some, some if x is sums else self.give(x, part, 1), ridge)
            self.take(sums, part, some)
        _changed(sums)

    def add_fixed(self, x: AnyVector, sums: cl.Buffer, unit: float, constant: bool = False) -> None:
        """See :meth:`VectorSpace.add_fixed`."""
        length = 3 * self.layout.stride if constant else self.length
        if not isinstance(x, HostColumns):
            self.own.add_fixed_some(x, sums, 0, length, unit)
            return
        # Of zeros all are written: they only stand for them.
        for first, count in self._pieces(self.length if x.zero else length):
            some = self._piece_of(x, 0, first, count)
            self.own.add_fixed_some(some, sums, first, count, unit)
            self._take_piece(x, some, first, count)
        x.changed()

    # ------------------------------------------------------------------------------------------ to and from elsewhere

    def on_device(self, x: AnyVector, place: int = 0) -> cl.Buffer:
        """See :meth:`VectorSpace.on_device`. What is there already is not taken there again."""
        if not isinstance(x, HostColumns):
            return x
        # The direction is on the device itself: the other vector may have its place.
        place = 0 if self._resident else place
        if self._operands[place] is None:
            self._operands[place] = self._memory.allocate(4 * self.length, "the SH coefficients")
        buffer = self._operands[place]
        held = self._held[place]
        if held is None or held[0] is not x or held[1] != x.changes:
            if x.zero:
                self.clear(buffer)
            else:
                self.ferry.to_device(buffer, [Cargo(x.values.reshape(-1))])
            self._held[place] = (x, x.changes)
        return buffer

    def write_sh(self, x: AnyVector, sh: FloatArray) -> None:
        """Set a vector from (N, M, 3) R, G, B."""
        for part in self.parts():
            rows = np.ascontiguousarray(sh[part.start : part.stop], np.float32)
            self.own.write_sh(self._slices[0], rows)
            self.take(x, part, self._slices[0])
        _changed(x)

    def read_sh(self, x: AnyVector) -> FloatArray:
        """(N, M, 3) float32, a vector in R, G, B; each coefficient contiguous in memory, which may be a file's."""
        layout = self.layout
        sh = mapped.array((layout.columns, layout.splats), np.float32, "SH coefficients")
        for part in self.parts():
            self.own.to_rgb(self.give(x, part, 0), self._slices[1])
            self._rectangle(sh, range(part.start, min(part.stop, layout.splats)), self._slices[1], to_device=False)
        return sh.reshape(layout.sh_count, 3, layout.splats).transpose(2, 0, 1)

    # ------------------------------------------------------------------------------------------ slices

    def parts(self) -> Iterator[range]:
        """The splats of each slice."""
        for first in range(0, self.layout.stride, self._splats):
            yield range(first, min(first + self._splats, self.layout.stride))

    def give(self, x: AnyVector, part: range, place: int) -> cl.Buffer:
        """A slice of a vector, on the device: valid until the next call for the place, 0 or 1."""
        self.copy_part(x, part, self._slices[place])
        return self._slices[place]

    def place(self, number: int) -> cl.Buffer:
        """Where :meth:`give` puts slices."""
        return self._slices[number]

    def copy_part(self, x: AnyVector, part: range, buffer: cl.Buffer) -> None:
        """A slice of columns to a buffer on the device, of as many columns as a slice has splats."""
        if not isinstance(x, HostColumns):
            self._on_device_rectangle(x, part, buffer, to_slice=True)
        elif x.zero:
            self.clear(buffer)
        else:
            self._rectangle(x.values, part, buffer, to_device=True)

    def take(self, x: AnyVector, part: range, buffer: cl.Buffer) -> None:
        """A slice of columns from the device. The columns are :meth:`HostColumns.changed` when all have come."""
        if isinstance(x, HostColumns):
            self._rectangle(x.values, part, buffer, to_device=False)
        else:
            self._on_device_rectangle(x, part, buffer, to_slice=False)

    def give_flags(self, part: range) -> None:
        """Have the flags of a slice's splats be those of :attr:`own`."""
        self._on_device_rectangle(self._active, part, self.own.active, to_slice=True, columns=2)

    def take_flags(self, part: range) -> None:
        """Take the flags of a slice's splats from :attr:`own`."""
        self._on_device_rectangle(self._active, part, self.own.active, to_slice=False, columns=2)

    def each(self, x: AnyVector, work: Callable[[range, cl.Buffer], None]) -> None:
        """Have work done on the slices of a vector and on their flags.

        Args:
            x: the vector.
            work: called with the splats and the slice on the device; the flags are those of :attr:`own`.
        """
        for part in self.parts():
            self.give_flags(part)
            some = self.give(x, part, 0)
            work(part, some)
            self.take(x, part, some)
            self.take_flags(part)
        _changed(x)

    def _pieces(self, length: int | None = None) -> Iterator[tuple[int, int]]:
        """The first value of each piece of a vector, and how many it has."""
        length = self.length if length is None else length
        for first in range(0, length, self._piece):
            yield first, min(self._piece, length - first)

    def _piece_of(self, x: AnyVector, place: int, first: int, count: int) -> cl.Buffer:
        if not isinstance(x, HostColumns):
            # Not a part of the buffer: NVIDIA's driver carries these to the host and back.
            cl.enqueue_copy(self.device.queue, self._slices[place], x, byte_count=4 * count, src_offset=4 * first)
        elif x.zero:
            self.clear(self._slices[place])
        else:
            self.ferry.to_device(self._slices[place], [Cargo(x.values.reshape(-1)[first : first + count])])
        return self._slices[place]

    def _take_piece(self, x: AnyVector, buffer: cl.Buffer, first: int, count: int) -> None:
        if isinstance(x, HostColumns):
            self.ferry.to_host([Cargo(x.values.reshape(-1)[first : first + count])], buffer)
        else:
            cl.enqueue_copy(self.device.queue, x, buffer, byte_count=4 * count, dst_offset=4 * first)

    def _rectangle(self, values: FloatArray, part: range, buffer: cl.Buffer, to_device: bool) -> None:
        """Copy some splats of all columns."""
        cargo = [Cargo(values, columns=part)]
        if to_device:
            self.ferry.to_device(buffer, cargo, pitch=4 * self._splats)
        else:
            self.ferry.to_host(cargo, buffer, pitch=4 * self._splats)

    def _on_device_rectangle(
        self, x: cl.Buffer, part: range, buffer: cl.Buffer, to_slice: bool, columns: int | None = None
    ) -> None:
        """The same between a vector on the device and a slice; or of so many columns."""
        whole, some = ((4 * part.start, 0, 0), (4 * self.layout.stride, 0)), ((0, 0, 0), (4 * self._splats, 0))
        source, target = (whole, some) if to_slice else (some, whole)
        with self.device.errors("failed while computing"):
            cl.enqueue_copy(
                self.device.queue,
                *((buffer, x) if to_slice else (x, buffer)),
                src_origin=source[0],
                dst_origin=target[0],
                region=(4 * len(part), columns or self.layout.columns, 1),
                src_pitches=source[1],
                dst_pitches=target[1],
            )

    # ------------------------------------------------------------------------------------------ flags

    def save_flags(self) -> NDArray[np.uint32]:
        """See :meth:`VectorSpace.save_flags`."""
        words: NDArray[np.uint32] = self.device.download(self._active, (2, self.layout.stride), np.uint32)
        return words

    def restore_flags(self, words: NDArray[np.uint32]) -> None:
        """See :meth:`VectorSpace.restore_flags`."""
        with self.device.errors("failed while computing"):
            cl.enqueue_copy(self.device.queue, self._active, words, is_blocking=True)

    def close(self) -> None:
        """Give all device memory back; the vectors' files go with the vectors."""
        self._held = [None] * _OPERANDS
        self._operands = [None] * _OPERANDS
        self.own.close()
        self.ferry.close()
        self._memory.close()


def _changed(x: AnyVector) -> None:
    if isinstance(x, HostColumns):
        x.changed()
