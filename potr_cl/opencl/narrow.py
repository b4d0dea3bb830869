"""64-bit integers on their way to another computer, with the bytes that they need: :class:`Narrowing`.

Sums in fixed point have room for what is never there: most need half of their bytes. Nothing is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch, Staging

_SOURCE = "opencl/narrow.cl"
#: Values of a run (RUN of the kernels), and work-items of a work-group.
_RUN, _GROUP = 64, 64
_WHAT = "integers on their way"


@dataclass(frozen=True)
class Narrowed:
    """Integers.

    Attributes:
        shape: of the array of int64 that they are.
        widths: (runs,) uint8, the bytes of each value of a run of 64, 0 to 8.
        data: uint8, run by run, value by value, the lowest byte first, in two's complement.
    """

    shape: tuple[int, ...]
    widths: NDArray[np.uint8]
    data: NDArray[np.uint8]

    @property
    def count(self) -> int:
        """How many integers there are."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def nbytes(self) -> int:
        """Bytes that travel."""
        return self.widths.nbytes + self.data.nbytes

    def starts(self) -> NDArray[np.uint64]:
        """(runs,) uint64, where the bytes of each run begin.

        Raises:
            ValueError: the parts do not fit each other.
        """
        runs = -(-self.count // _RUN)
        lengths = _RUN * self.widths.astype(np.uint64)
        if len(self.widths) == runs and runs:
            lengths[-1] = np.uint64(int(self.widths[-1]) * (self.count - _RUN * (runs - 1)))
        ends = np.cumsum(lengths, dtype=np.uint64)
        if len(self.widths) != runs or (runs and (self.widths.max() > 8 or int(ends[-1]) != len(self.data))):
            raise ValueError(f"{len(self.data)} bytes in {len(self.widths)} runs are not {self.count} integers")
        starts: NDArray[np.uint64] = ends - lengths
        return starts

    def widened(self) -> NDArray[np.int64]:
        """The integers, of this shape.

        Raises:
            ValueError: the parts do not fit each other.
        """
        starts, count = self.starts(), self.count
        padded = np.concatenate([self.data, np.zeros(8 * _RUN, np.uint8)])
        values = np.zeros((len(self.widths), _RUN), np.uint64)
        for width in range(1, 9):
            own = np.flatnonzero(self.widths == width)
            places = starts[own, None].astype(np.int64) + width * np.arange(_RUN)
            for k in range(width):
                values[own] |= padded[np.minimum(places + k, len(padded) - 1)].astype(np.uint64) << np.uint64(8 * k)
            above = np.uint64(64 - 8 * width)
            values[own] = ((values[own] << above).view(np.int64) >> above.astype(np.int64)).view(np.uint64)
        return values.view(np.int64).ravel()[:count].reshape(self.shape)


class Narrowing(Owner):
    """Takes integers from a device, and brings such to it.

    Args:
        device: the device.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._kernels = {name: device.shared_kernel(_SOURCE, name) for name in ("widths_of", "narrow", "widen")}
        self._widths, self._starts = Scratch(device, _WHAT), Scratch(device, _WHAT)
        self._bytes = Scratch(device, _WHAT)
        self._staging = Staging(device)

    def download(self, values: cl.Buffer, shape: tuple[int, ...], start: int = 0) -> Narrowed:
        """Integers of a buffer, once all is done that has been enqueued before; valid until the next call.

        Args:
            values: int64.
            shape: of the array that they are.
            start: number of the first of them.
        """
        count = int(np.prod(shape, dtype=np.int64))
        if not count:
            return Narrowed(shape, np.zeros(0, np.uint8), np.zeros(0, np.uint8))
        runs = -(-count // _RUN)
        self._widths.reserve(runs)
        given = {"values": values, "start": start, "count": count, "widths": self._widths.buffer}
        self._launch("widths_of", runs, **given)
        widths = self._device.download(self._widths.buffer, (runs,), np.uint8)
        lengths = _RUN * widths.astype(np.uint64)
        lengths[-1] = np.uint64(int(widths[-1]) * (count - _RUN * (runs - 1)))
        ends = np.cumsum(lengths, dtype=np.uint64)
        self._copy(self._starts, ends - lengths)
        self._bytes.reserve(max(int(ends[-1]), 1))
        self._launch("narrow", count, **given, starts=self._starts.buffer, bytes=self._bytes.buffer)
        return Narrowed(shape, widths, self._staging.download(self._bytes.buffer, (int(ends[-1]),), np.uint8))

    def upload(self, values: cl.Buffer, narrowed: Narrowed) -> None:
        """Enqueue that a buffer begins with these integers.

        Raises:
            ValueError: their parts do not fit each other.
        """
        if not narrowed.count:
            return
        starts = narrowed.starts()
        self._copy(self._widths, narrowed.widths)
        self._copy(self._starts, starts)
        self._copy(self._bytes, narrowed.data)
        self._launch(
            "widen",
            narrowed.count,
            values=values,
            count=narrowed.count,
            widths=self._widths.buffer,
            starts=self._starts.buffer,
            bytes=self._bytes.buffer,
        )

    def _copy(self, scratch: Scratch, array: NDArray[np.generic]) -> None:
        scratch.reserve(max(array.nbytes, 1))
        if array.nbytes:
            with self._device.errors("failed while computing"):
                cl.enqueue_copy(self._device.queue, scratch.buffer, array, is_blocking=True)

    def _launch(self, name: str, items: int, **arguments: object) -> None:
        kernel = self._kernels[name]
        kernel.bind(**arguments)
        kernel.launch((-(-items // _GROUP) * _GROUP,), (_GROUP,))

    def close(self) -> None:
        """Give the device's memory back."""
        for scratch in (self._widths, self._starts, self._bytes):
            scratch.close()
        self._staging.close()
