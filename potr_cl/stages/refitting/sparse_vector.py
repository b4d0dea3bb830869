"""Vectors of coefficients on their way to another computer, without what is 0: :class:`SparseVectors`.

Once coefficients have been given up, nine of ten are 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Memory, Owner, Scratch, Staging
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.packed_row import PackedRow, packing_kernel

#: Work-items of a work-group.
_GROUP = 64


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


#: A vector that travels; or its columns, (3 M, N) float32, where most are not 0.
SentVector: TypeAlias = "SparseVector | FloatArray"


class SparseVectors(Owner):
    """Takes vectors from a device, and brings such to it.

    Args:
        coefficients: whose vectors these are.

    Raises:
        DeviceError: the device has no room, or the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients) -> None:
        self._coefficients = coefficients
        device, layout = coefficients.device, coefficients.layout
        self._mark = packing_kernel(coefficients, "mark_nonzero")
        self._packed = Scratch(device, "the packed coefficients")
        self._staging, self._columns = Staging(device), Staging(device)
        self._memory = Memory(device)
        self._flags = self._memory.allocate(8 * layout.stride, "which coefficients are not 0")
        try:
            self._row = PackedRow(coefficients, self._flags)
        except BaseException:
            self._memory.close()
            raise

    def take(self, x: cl.Buffer) -> SentVector:
        """A vector, bit for bit; valid until the next call."""
        device, layout = self._coefficients.device, self._coefficients.layout
        self._mark.bind(columns=x, stride=layout.stride, splats=layout.splats, flags=self._flags)
        self._mark.launch((-(-layout.splats // _GROUP) * _GROUP,), (_GROUP,))
        self._row.settle()
        if 8 * layout.splats + 4 * self._row.count >= 4 * layout.columns * layout.splats:
            columns: FloatArray = self._columns.download(x, (layout.columns, layout.stride), np.float32)
            return columns[:, : layout.splats]
        self._packed.reserve(max(4 * self._row.count, 1))
        self._row.pack_floats(x, self._packed.buffer)
        flags = device.download(self._flags, (2, layout.stride), np.uint32)[:, : layout.splats]
        values = self._staging.download(self._packed.buffer, (self._row.count,), np.float32)
        return SparseVector(np.ascontiguousarray(flags), values)

    def give(self, x: cl.Buffer, sent: SentVector) -> None:
        """Set a vector.

        Raises:
            ValueError: there are not as many values as flags, or they are not of so many splats.
        """
        if not isinstance(sent, SparseVector):
            self._coefficients.write(x, sent)
            return
        device, layout = self._coefficients.device, self._coefficients.layout
        words = np.zeros((2, layout.stride), np.uint32)
        words[:, : layout.splats] = sent.flags
        with device.errors("failed while computing"):
            cl.enqueue_copy(device.queue, self._flags, words, is_blocking=True)
        self._row.settle()
        if self._row.count != len(sent.values):
            raise ValueError(f"{len(sent.values)} coefficients, where {self._row.count} are not 0")
        self._packed.reserve(max(sent.values.nbytes, 1))
        if len(sent.values):
            with device.errors("failed while computing"):
                cl.enqueue_copy(device.queue, self._packed.buffer, sent.values, is_blocking=True)
        self._row.unpack_floats(x, self._packed.buffer)

    def close(self) -> None:
        """Give the device's memory back."""
        self._row.close()
        self._packed.close()
        self._staging.close()
        self._columns.close()
        self._memory.close()
