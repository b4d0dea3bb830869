"""The coefficients of the splats that each worker's views draw, and no others: :class:`DrawnRows`."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Memory, Owner, Staging
from potr_cl.opencl.narrow import Narrowed
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.packed_row import PackedRow
from potr_cl.stages.refitting.packing import Packing

#: Rows of their own are worth it if all together have no more than this part of the splats.
_WORTH_IT = 0.9


class DrawnRows(Owner):
    """Rows of active coefficients, one for each part of the views.

    Args:
        coefficients: whose vectors are packed, by their flags as they are now until :meth:`take_flags`.
        packing: of the same.
        drawn: (N,) which splats the views of each part draw, by the part's number.

    Raises:
        DeviceMemoryError: the device has no room.
    """

    def __init__(self, coefficients: Coefficients, packing: Packing, drawn: Mapping[int, NDArray[np.bool_]]) -> None:
        self._device, self._layout, self._packing = coefficients.device, coefficients.layout, packing
        self._drawn = [drawn[part] for part in range(len(drawn))]
        with ExitStack() as owned:
            memory = owned.enter_context(Memory(self._device))
            self._flags = [memory.allocate(8 * self._layout.stride, "the active coefficients") for _ in self._drawn]
            self._rows = [owned.enter_context(PackedRow(coefficients, flags)) for flags in self._flags]
            self._staging = [owned.enter_context(Staging(self._device)) for _ in self._drawn]
            self.take_flags(packing.flags())
            self._owned = owned.pop_all()

    @staticmethod
    def are_worth_it(drawn: Mapping[int, NDArray[np.bool_]]) -> bool:
        """Whether enough splats are left out of the rows."""
        return sum(float(each.mean()) for each in drawn.values()) <= _WORTH_IT * len(drawn)

    def take_flags(self, active: NDArray[np.uint32]) -> list[NDArray[np.uint32]]:
        """Pack by these flags, (2, N) uint32, from now on; those of each part's splats."""
        found = []
        for drawn, buffer, row in zip(self._drawn, self._flags, self._rows, strict=True):
            own = active * drawn
            words = np.zeros((2, self._layout.stride), np.uint32)
            words[:, : self._layout.splats] = own
            with self._device.errors("failed while computing"):
                cl.enqueue_copy(self._device.queue, buffer, words, is_blocking=True)
            row.settle()
            found.append(own)
        return found

    def floats(self, x: cl.Buffer) -> list[FloatArray]:
        """A vector's coefficients in each row; valid until the next call."""
        return [self._packing.floats(x, *each) for each in zip(self._rows, self._staging, strict=True)]

    def add_sums(self, columns: cl.Buffer, part: int, packed: Narrowed) -> None:
        """Add the sums of one part's row to sums over views."""
        self._packing.add_sums(columns, packed, self._rows[part])

    def close(self) -> None:
        """Give the device's memory back."""
        self._owned.close()
