"""What travels between the devices that do the views of a re-fit: :class:`Exchange`.

Devices of one process lend each other their memory. To another computer go the coefficients that may change, splat by
splat in one row (:class:`PackedRow`), and vectors without what is 0: once coefficients have
been given up, nine of ten are.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner, Scratch, Staging
from potr_cl.opencl.narrow import Narrowed, Narrowing
from potr_cl.opencl.relay import Lent, Relay, done_so_far
from potr_cl.stages.refitting.coefficients import Coefficients

_SOURCE = "refit/packing.cl"
#: Work-items of a work-group.
GROUP = 64
#: Splats whose coefficients a work-item counts one after the other.
_RUN = 64
_WHAT = "the coefficients' places"


class PackedRow(Owner):
    """Where the coefficients lie in a row whose flags are set.

    Args:
        coefficients: whose vectors are packed.
        flags: (2, stride) uint32 on their device, as :attr:`Coefficients.active`.

    Attributes:
        flags: as given.
        count: coefficients whose flags were set when :meth:`settle` was called last.
    """

    def __init__(self, coefficients: Coefficients, flags: cl.Buffer) -> None:
        self._device, self._layout, self.flags = coefficients.device, coefficients.layout, flags
        names = [
            "mark_nonzero",
            "count_active",
            "place_active",
            "pack_floats",
            "unpack_floats",
            "pack_sums",
            "add_sums",
        ]
        self._kernels = {name: packing_kernel(coefficients, name) for name in names}
        self._places, self._starts = Scratch(self._device, _WHAT), Scratch(self._device, _WHAT)
        self.count = 0

    def settle(self) -> None:
        """Pack by the flags as they are on the device from now on."""
        runs = -(-self._layout.splats // _RUN)
        self._starts.reserve(8 * runs)
        self._places.reserve(8 * self._layout.splats)
        self._launch_runs("count_active", counts=self._starts.buffer)
        counts = self._device.download(self._starts.buffer, (runs,), np.uint64)
        ends = np.cumsum(counts, dtype=np.uint64)
        self.count = int(ends[-1])
        self._device.copy(self._starts.buffer, ends - counts)
        self._launch_runs("place_active", starts=self._starts.buffer, places=self._places.buffer)

    def set_flags(self, flags: NDArray[np.uint32]) -> None:
        """Pack by these, (2, N), from now on."""
        self._device.copy(self.flags, self.padded(flags))
        self.settle()

    def padded(self, flags: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """(2, stride), flags of N splats as they lie on the device."""
        words = np.zeros((2, self._layout.stride), np.uint32)
        words[:, : flags.shape[1]] = flags
        return words

    def mark_nonzero(self, x: cl.Buffer) -> None:
        """Pack by what is not 0 in a vector from now on."""
        kernel, splats = self._kernels["mark_nonzero"], self._layout.splats
        kernel.bind(columns=x, stride=self._layout.stride, splats=splats, flags=self.flags)
        kernel.launch((-(-splats // GROUP) * GROUP,), (GROUP,))
        self.settle()

    def _launch_runs(self, name: str, **buffers: cl.Buffer) -> None:
        kernel, splats = self._kernels[name], self._layout.splats
        kernel.bind(active=self.flags, stride=self._layout.stride, splats=splats, **buffers)
        kernel.launch((-(-splats // (_RUN * GROUP)) * GROUP,), (GROUP,))

    def move(self, how: str, columns: cl.Buffer, packed: cl.Buffer) -> None:
        """Enqueue a kernel of cl/refit/packing.cl.

        Args:
            how: "pack_floats": a vector's coefficients to the row, (count,) float32. "unpack_floats": from the row to a
                vector, in which all others become 0. "pack_sums": sums over views to the row, (count,) int64, after
                which all sums are 0. "add_sums": the row is added to sums over views.
            columns: the vector or the sums.
            packed: the row.
        """
        kernel, splats = self._kernels[how], self._layout.splats
        kernel.bind(
            columns=columns,
            active=self.flags,
            stride=self._layout.stride,
            splats=splats,
            places=self._places.buffer,
            packed=packed,
        )
        kernel.launch((-(-splats // GROUP) * GROUP,), (GROUP,))

    def close(self) -> None:
        """Give the device's memory back."""
        self._places.close()
        self._starts.close()


def packing_kernel(coefficients: Coefficients, name: str) -> Kernel:
    """A kernel of the program that packs a scene's coefficients, which is built once."""
    return coefficients.device.kernel(_SOURCE, name, LANES=1, SH_COUNT=coefficients.layout.sh_count, RUN=_RUN)


#: Bytes of lent sums that are added at a time.
_AT_ONCE = 1 << 27


@dataclass(frozen=True)
class SparseVector:
    """A vector.

    Attributes:
        flags: (2, N) uint32, a bit for each coefficient of N splats that is not 0, as
            :attr:`potr_cl.stages.refitting.coefficients.Coefficients.active` has them.
        values: (n,) float32, these coefficients, splat by splat.
    """

    flags: NDArray[np.uint32]
    values: FloatArray

    @property
    def nbytes(self) -> int:
        """Bytes that travel."""
        return self.flags.nbytes + self.values.nbytes


#: A vector that travels; or its columns, (3 M, N) float32, where most are not 0; or where it lies.
SentVector: TypeAlias = "SparseVector | FloatArray | Lent"


class Exchange(Owner):
    """Sends what lies on one device, and takes what comes from others.

    Args:
        coefficients: whose vectors and flags it is.
        lends: whether the others are threads of this process, which read what lies on the device themselves.

    Attributes:
        lends: as given, until flags are taken: who is lent something lends its own.
    """

    def __init__(self, coefficients: Coefficients, lends: bool = False) -> None:
        self._coefficients, self._device, self.lends = coefficients, coefficients.device, lends
        device = coefficients.device
        self._add_rows = packing_kernel(coefficients, "add_rows")
        self._row = PackedRow(coefficients, coefficients.active)
        self._staging, self._columns = Staging(device), Staging(device)
        self._relay, self._narrowing = Relay(device), Narrowing(device)
        self._packed = Scratch(device, "the packed coefficients")
        # What comes from others has a place of its own: it arrives while the device still computes.
        self._arrived = Scratch(device, "the packed coefficients")
        # When that place is looked at no more; None: what comes next waits for everything.
        self._free: cl.Event | None = None
        self._memory = Memory(device)
        self._not_zero: PackedRow | None = None

    # ------------------------------------------------------------------------------------------ flags

    def flags(self) -> NDArray[np.uint32]:
        """(2, N) uint32, the flags as they are on the device."""
        return np.ascontiguousarray(self._coefficients.save_flags()[:, : self._coefficients.layout.splats])

    def send_flags(self) -> NDArray[np.uint32] | Lent:
        """The same, or where they lie."""
        coefficients = self._coefficients
        return self._lent(coefficients.active, 8 * coefficients.layout.stride) if self.lends else self.flags()

    def settle(self) -> None:
        """Pack by the flags as they are on the device from now on."""
        self._row.settle()

    def take_flags(self, flags: NDArray[np.uint32] | Lent) -> None:
        """Have these flags, (2, N) uint32, on the device, and pack by them from now on."""
        self.lends = isinstance(flags, Lent)
        if isinstance(flags, Lent):
            self._relay.fetch(self._coefficients.active, flags)
        else:
            self._coefficients.restore_flags(self._row.padded(flags))
        self.settle()

    # ------------------------------------------------------------------------------------------ vectors

    def send_vector(self, x: cl.Buffer) -> SentVector:
        """A vector, bit for bit; valid until the next call, or until it changes."""
        layout = self._coefficients.layout
        if self.lends:
            return self._lent(x, 4 * layout.columns * layout.stride)
        row = self._of_not_zero()
        row.mark_nonzero(x)
        if 8 * layout.splats + 4 * row.count >= 4 * layout.columns * layout.splats:
            columns: FloatArray = self._columns.download(x, (layout.columns, layout.stride), np.float32)
            return columns[:, : layout.splats]
        flags = self._device.download(row.flags, (2, layout.stride), np.uint32)[:, : layout.splats]
        floats = self.send_floats(x, row, self._columns)
        assert isinstance(floats, np.ndarray)
        return SparseVector(np.ascontiguousarray(flags), floats)

    def take_vector(self, x: cl.Buffer, sent: SentVector) -> None:
        """Set a vector.

        Raises:
            ValueError: there are not as many values as flags, or they are not of so many splats.
        """
        if isinstance(sent, Lent):
            self._relay.fetch(x, sent)
        elif isinstance(sent, SparseVector):
            row = self._of_not_zero()
            row.set_flags(sent.flags)
            self.take_floats(x, sent.values, row)
        else:
            self._coefficients.write(x, sent)

    def _of_not_zero(self) -> PackedRow:
        """The coefficients that are not 0 in the vector that was sent or taken last."""
        if self._not_zero is None:
            flags = self._memory.allocate(8 * self._coefficients.layout.stride, "which coefficients are not 0")
            self._not_zero = PackedRow(self._coefficients, flags)
        return self._not_zero

    def send_floats(
        self, x: cl.Buffer, row: PackedRow | None = None, staging: Staging | None = None
    ) -> FloatArray | Lent:
        """(count,) float32, a vector's active coefficients; valid until something else is packed.

        Args:
            x: the vector.
            row: another row than that of all active coefficients.
            staging: where they are put, and valid as long as nothing else is put there; None: a place of this.
        """
        row = row or self._row
        self._packed.reserve(max(4 * row.count, 1))
        row.move("pack_floats", x, self._packed.buffer)
        if self.lends:
            return self._lent(self._packed.buffer, 4 * row.count)
        packed: FloatArray = (staging or self._staging).download(self._packed.buffer, (row.count,), np.float32)
        return packed

    def take_floats(self, x: cl.Buffer, packed: FloatArray | Lent, row: PackedRow | None = None) -> None:
        """Set a vector; coefficients that are not active become 0.

        Raises:
            ValueError: they are not as many as are active.
        """
        row = row or self._row
        self._take(packed, 4, row.count)
        row.move("unpack_floats", x, self._arrived.buffer)
        self._looked_at(packed)

    # ------------------------------------------------------------------------------------------ sums

    def send_sums(self, columns: cl.Buffer) -> Narrowed | Lent:
        """(count,) int64, sums over views of active coefficients; valid until something else is sent.

        All sums become 0.
        """
        count = self._row.count
        self._packed.reserve(max(8 * count, 1))
        self._row.move("pack_sums", columns, self._packed.buffer)
        if self.lends:
            return self._lent(self._packed.buffer, 8 * count)
        return self._narrowing.download(self._packed.buffer, (count,))

    def add_sums(self, columns: cl.Buffer, packed: Narrowed | Lent, row: PackedRow | None = None) -> None:
        """Add to sums over views; those of another row than that of all active coefficients."""
        row = row or self._row
        self._take(packed, 8, row.count)
        row.move("add_sums", columns, self._arrived.buffer)
        self._looked_at(packed)

    def rows(self, sums: cl.Buffer, row: int, rows: int) -> Narrowed:
        """(rows, stride) int64, rows of sums from one on; valid until something else is sent."""
        stride = self._coefficients.layout.stride
        return self._narrowing.download(sums, (rows, stride), stride * row, turned=True)

    def add_rows(self, sums: cl.Buffer, row: int, more: Narrowed) -> None:
        """Add whole rows, (rows, n) int64, to sums from a row on; n may be another device's stride."""
        rows, stride = more.shape
        own, splats = self._coefficients.layout.stride, self._coefficients.layout.splats
        self._make_room(8 * rows * max(stride, own))
        if stride == own:
            self._narrowing.upload(self._arrived.buffer, more)
        else:
            padded = np.zeros((rows, own), np.int64)
            padded[:, :splats] = more.widened()[:, :splats]
            self._copy_to_arrived(padded)
        self._add_arrived(sums, row * own, rows * own)
        self._looked_at(more)

    def add_lent(self, sums: cl.Buffer, more: Lent) -> None:
        """Add all of a device's sums, as many int64 as there are here, some at a time."""
        for start in range(0, more.nbytes, _AT_ONCE):
            nbytes = min(_AT_ONCE, more.nbytes - start)
            self._make_room(nbytes)
            self._relay.fetch(self._arrived.buffer, more, start, nbytes, self._free)
            self._add_arrived(sums, start // 8, nbytes // 8)
            self._looked_at(more)

    # ------------------------------------------------------------------------------------------ their parts

    def _lent(self, buffer: cl.Buffer, nbytes: int) -> Lent:
        return Lent(self._device, buffer, nbytes)

    def _add_arrived(self, sums: cl.Buffer, start: int, count: int) -> None:
        self._add_rows.bind(sums=sums, start=start, more=self._arrived.buffer, count=count)
        self._add_rows.launch((-(-count // GROUP) * GROUP,), (GROUP,))

    def _take(self, packed: NDArray[np.generic] | Narrowed | Lent, nbytes: int, expected: int) -> None:
        """Have so many packed coefficients, of so many bytes each, on the device."""
        count = packed.count if isinstance(packed, Narrowed) else packed.nbytes // nbytes
        if count != expected:
            raise ValueError(f"{count} packed coefficients, where there should be {expected}")
        self._make_room(nbytes * count)
        if isinstance(packed, Narrowed):
            self._narrowing.upload(self._arrived.buffer, packed)
        elif isinstance(packed, Lent):
            self._relay.fetch(self._arrived.buffer, packed, free=self._free)
        else:
            self._copy_to_arrived(packed)

    def _make_room(self, nbytes: int) -> None:
        """For what arrives."""
        if self._arrived.reserve(max(nbytes, 1)):
            self._free = None

    def _looked_at(self, packed: NDArray[np.generic] | Narrowed | Lent) -> None:
        """The device looks no more at what has arrived, once it has done what it has been given by now."""
        # What the host copies waits for the device anyway. And a marker costs: with one in the queue, Intel's CPU
        # runtime leaves the thread idle that waits for a result, instead of computing on it.
        self._free = done_so_far(self._device) if isinstance(packed, Lent) else None

    def _copy_to_arrived(self, array: NDArray[np.generic]) -> None:
        if array.nbytes:
            self._device.copy(self._arrived.buffer, array)

    def close(self) -> None:
        """Give the device's memory back."""
        rows = [self._row] if self._not_zero is None else [self._row, self._not_zero]
        parts = (self._packed, self._arrived, self._staging, self._columns, self._relay, self._narrowing, self._memory)
        for owner in (*rows, *parts):
            owner.close()


#: Rows of their own are worth it if all together have no more than this part of the splats.
_WORTH_IT = 0.9


class DrawnRows(Owner):
    """Rows of active coefficients, one for each part of the views.

    Args:
        coefficients: whose vectors are packed, by their flags as they are now until :meth:`take_flags`.
        exchange: of the same.
        drawn: (N,) which splats the views of each part draw, by the part's number.
    """

    def __init__(self, coefficients: Coefficients, exchange: Exchange, drawn: Mapping[int, NDArray[np.bool_]]) -> None:
        self._exchange = exchange
        self._drawn = [drawn[part] for part in range(len(drawn))]
        self._rows: list[PackedRow] = []
        self._staging: list[Staging] = []
        with ExitStack() as owned:
            memory = owned.enter_context(Memory(coefficients.device))
            for _ in self._drawn:
                flags = memory.allocate(8 * coefficients.layout.stride, "the active coefficients")
                self._rows.append(owned.enter_context(PackedRow(coefficients, flags)))
                self._staging.append(owned.enter_context(Staging(coefficients.device)))
            self.take_flags(exchange.flags())
            self._owned = owned.pop_all()

    @staticmethod
    def are_worth_it(drawn: Mapping[int, NDArray[np.bool_]]) -> bool:
        """Whether enough splats are left out of the rows."""
        return sum(float(each.mean()) for each in drawn.values()) <= _WORTH_IT * len(drawn)

    def take_flags(self, active: NDArray[np.uint32]) -> list[NDArray[np.uint32]]:
        """Pack by these flags, (2, N) uint32, from now on; those of each part's splats."""
        found = [active * drawn for drawn in self._drawn]
        for own, row in zip(found, self._rows, strict=True):
            row.set_flags(own)
        return found

    def floats(self, x: cl.Buffer) -> list[FloatArray | Lent]:
        """A vector's coefficients in each row; valid until the next call."""
        return [self._exchange.send_floats(x, *each) for each in zip(self._rows, self._staging, strict=True)]

    def add_sums(self, columns: cl.Buffer, part: int, packed: Narrowed) -> None:
        """Add the sums of one part's row to sums over views."""
        self._exchange.add_sums(columns, packed, self._rows[part])
