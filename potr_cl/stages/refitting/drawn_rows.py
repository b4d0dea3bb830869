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
from potr_cl.opencl.relay import Lent
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.exchange import Exchange
from potr_cl.stages.refitting.packed_row import PackedRow

#: Rows of their own are worth it if all together have no more than this part of the splats.
_WORTH_IT = 0.9


class DrawnRows(Owner):
    """Rows of active coefficients, one for each part of the views.

    Args:
        coefficients: whose vectors are packed, by their flags as they are now until :meth:`take_flags`.
        exchange: of the same.
        drawn: (N,) which splats the views of each part draw, by the part's number.

    Raises:
        DeviceMemoryError: the device has no room.
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

    def close(self) -> None:
        """Give the device's memory back."""
        self._owned.close()
