"""Coefficients that may change, as they travel between devices: :class:`Packing`."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Owner, Scratch, Staging
from potr_cl.opencl.narrow import Narrowed, Narrowing
from potr_cl.opencl.relay import Lent, Relay, done_so_far
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.packed_row import PackedRow, packing_kernel

#: Work-items of a work-group.
_GROUP = 64
#: Bytes of lent sums that are added at a time.
_AT_ONCE = 1 << 27


class Packing(Owner):
    """Packs the active coefficients of a scene's splats in one row, splat by splat, and unpacks such rows.

    Args:
        coefficients: whose vectors and flags they are.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients) -> None:
        self._coefficients, device = coefficients, coefficients.device
        self._add_rows = packing_kernel(coefficients, "add_rows")
        self._row = PackedRow(coefficients, coefficients.active)
        self._staging = Staging(device)
        self._relay = Relay(device)
        self._narrowing = Narrowing(device)
        self._packed = Scratch(device, "the packed coefficients")
        # What comes from others has a place of its own: it arrives while the device still computes.
        self._arrived = Scratch(device, "the packed coefficients")
        # When that place is looked at no more; None: what comes next waits for everything.
        self._free: cl.Event | None = None

    @property
    def count(self) -> int:
        """Coefficients that were active when :meth:`take_flags` or :meth:`give_flags` was called last."""
        return self._row.count

    def take_flags(self) -> None:
        """Pack by the flags as they are on the device from now on."""
        self._row.settle()

    def flags(self) -> NDArray[np.uint32]:
        """(2, N) uint32, the flags as they are on the device."""
        return np.ascontiguousarray(self._coefficients.save_flags()[:, : self._coefficients.layout.splats])

    def lend_flags(self) -> Lent:
        """The same on the device, for others of this process."""
        coefficients = self._coefficients
        return Lent(coefficients.device, coefficients.active, 8 * coefficients.layout.stride)

    def give_flags(self, flags: NDArray[np.uint32] | Lent) -> None:
        """Have these flags, (2, N) uint32, on the device, and pack by them from now on."""
        if isinstance(flags, Lent):
            self._relay.fetch(self._coefficients.active, flags)
        else:
            words = np.zeros((2, self._coefficients.layout.stride), np.uint32)
            words[:, : flags.shape[1]] = flags
            self._coefficients.restore_flags(words)
        self.take_flags()

    def floats(self, x: cl.Buffer, row: PackedRow | None = None, staging: Staging | None = None) -> FloatArray:
        """(count,) float32, a vector's active coefficients; valid until something else is packed.

        Args:
            x: the vector.
            row: another row than that of all active coefficients.
            staging: where they are put, and valid as long as nothing else is put there; None: a place of this.
        """
        row = row or self._row
        self._packed.reserve(max(4 * row.count, 1))
        row.pack_floats(x, self._packed.buffer)
        packed: FloatArray = (staging or self._staging).download(self._packed.buffer, (row.count,), np.float32)
        return packed

    def lend_floats(self, x: cl.Buffer) -> Lent:
        """The same on the device, for others of this process."""
        self._packed.reserve(4 * self.count)
        self._row.pack_floats(x, self._packed.buffer)
        return Lent(self._coefficients.device, self._packed.buffer, 4 * self.count)

    def set_floats(self, x: cl.Buffer, packed: FloatArray | Lent) -> None:
        """Set a vector; coefficients that are not active become 0."""
        self._take(packed, 4, self.count)
        self._row.unpack_floats(x, self._arrived.buffer)
        self._looked_at(packed)

    def sums(self, columns: cl.Buffer) -> Narrowed:
        """(count,) int64, sums over views of active coefficients; valid until something else is narrowed.

        All sums become 0.
        """
        self._packed.reserve(8 * self.count)
        self._row.pack_sums(columns, self._packed.buffer)
        return self._narrowing.download(self._packed.buffer, (self.count,))

    def rows(self, sums: cl.Buffer, row: int, rows: int) -> Narrowed:
        """(rows, stride) int64, rows of sums from one on; valid until something else is narrowed."""
        stride = self._coefficients.layout.stride
        return self._narrowing.download(sums, (rows, stride), stride * row, turned=True)

    def lend_sums(self, columns: cl.Buffer) -> Lent:
        """The same on the device, for others of this process."""
        self._packed.reserve(8 * self.count)
        self._row.pack_sums(columns, self._packed.buffer)
        return Lent(self._coefficients.device, self._packed.buffer, 8 * self.count)

    def add_sums(self, columns: cl.Buffer, packed: Narrowed | Lent, row: PackedRow | None = None) -> None:
        """Add to sums over views; those of another row than that of all active coefficients."""
        row = row or self._row
        self._take(packed, 8, row.count)
        row.add_sums(columns, self._arrived.buffer)
        self._looked_at(packed)

    def add_rows(self, sums: cl.Buffer, row: int, more: Narrowed) -> None:
        """Add whole rows, (rows, n) int64, to sums from a row on; n may be another device's stride."""
        rows, stride = more.shape
        own = self._coefficients.layout.stride
        self._make_room(8 * rows * max(stride, own))
        if stride == own:
            self._narrowing.upload(self._arrived.buffer, more)
        else:
            padded = np.zeros((rows, own), np.int64)
            splats = self._coefficients.layout.splats
            padded[:, :splats] = more.widened()[:, :splats]
            self._copy_to(self._arrived, padded)
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

    def _add_arrived(self, sums: cl.Buffer, start: int, count: int) -> None:
        kernel = self._add_rows
        kernel.bind(sums=sums, start=start, more=self._arrived.buffer, count=count)
        kernel.launch((-(-count // _GROUP) * _GROUP,), (_GROUP,))

    def fetch(self, x: cl.Buffer, lent: Lent) -> None:
        """Take a whole vector from another device, which lays it out in the same way."""
        self._relay.fetch(x, lent)

    def _take(self, packed: NDArray[np.generic] | Narrowed | Lent, nbytes: int, expected: int) -> None:
        """Have so many packed coefficients, of so many bytes each, on the device."""
        count = packed.count if isinstance(packed, Narrowed) else packed.nbytes // nbytes
        if count != expected:
            raise ValueError(f"{count} packed coefficients, where {expected} are active")
        self._make_room(nbytes * count)
        if isinstance(packed, Narrowed):
            self._narrowing.upload(self._arrived.buffer, packed)
        elif isinstance(packed, Lent):
            self._relay.fetch(self._arrived.buffer, packed, free=self._free)
        else:
            self._copy_to(self._arrived, packed)

    def _make_room(self, nbytes: int) -> None:
        """For what arrives."""
        if self._arrived.reserve(nbytes):
            self._free = None

    def _looked_at(self, packed: NDArray[np.generic] | Narrowed | Lent) -> None:
        """The device looks no more at what has arrived, once it has done what it has been given by now."""
        # What the host copies waits for the device anyway. And a marker costs: with one in the queue, Intel's CPU
        # runtime leaves the thread idle that waits for a result, instead of computing on it.
        self._free = done_so_far(self._coefficients.device) if isinstance(packed, Lent) else None

    def _copy_to(self, scratch: Scratch, array: NDArray[np.generic]) -> None:
        if array.nbytes:
            device = self._coefficients.device
            with device.errors("failed while computing"):
                cl.enqueue_copy(device.queue, scratch.buffer, array, is_blocking=True)

    def close(self) -> None:
        """Give the device's memory back."""
        self._row.close()
        self._packed.close()
        self._arrived.close()
        self._staging.close()
        self._relay.close()
        self._narrowing.close()
