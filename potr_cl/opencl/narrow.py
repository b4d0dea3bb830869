"""64-bit integers on their way to another computer, with the bits that they need: :class:`Narrowing`.

Sums in fixed point have room for what is never there: most need less than half of their bits. Nothing is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch, Staging

_SOURCE = "opencl/narrow.cl"
#: Values of a run, and runs between two whose beginning is known (RUN and RUNS of the kernels); work-items of a
#: work-group.
_RUN, _RUNS, _GROUP = 16, 4, 64
_WHAT = "integers on their way"


@dataclass(frozen=True)
class Narrowed:
    """Integers.

    Attributes:
        shape: of the array of int64 that they are.
        widths: (runs,) uint8, the bits of each value of a run of 16, 0 to 64.
        data: (sum of the widths,) uint16, run by run: 16 values of so many bits, in two's complement, the first one in
            the lowest bits of the first word.
        turned: whether the integers of a table, (rows, n), come column by column.
    """

    shape: tuple[int, ...]
    widths: NDArray[np.uint8]
    data: NDArray[np.uint16]
    turned: bool = False

    @property
    def count(self) -> int:
        """How many integers there are."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def nbytes(self) -> int:
        """Bytes that travel."""
        return self.widths.nbytes + self.data.nbytes

    def starts(self) -> NDArray[np.uint64]:
        """(runs / 4, rounded up) uint64, where the words of every fourth run begin.

        Raises:
            ValueError: the parts do not fit each other.
        """
        starts, words = _starts(self.widths)
        fits = len(self.widths) == -(-self.count // _RUN) and words == len(self.data)
        if not fits or (words and self.widths.max() > 64) or (self.turned and len(self.shape) != 2):
            raise ValueError(f"{len(self.data)} words in {len(self.widths)} runs are not {self.count} integers")
        return starts

    def widened(self) -> NDArray[np.int64]:
        """The integers, of this shape.

        Raises:
            ValueError: the parts do not fit each other.
        """
        self.starts()  # they fit
        ends = np.cumsum(self.widths, dtype=np.int64)
        values = np.zeros((len(self.widths), _RUN), np.uint64)
        for width in np.unique(self.widths[self.widths > 0]).tolist():
            own = np.flatnonzero(self.widths == width)
            words = np.zeros((len(own), width + 4), np.uint64)  # what a value begins in, and four more
            words[:, :width] = self.data[(ends[own] - width)[:, None] + np.arange(width)]
            for k in range(_RUN):
                word, bit = divmod(k * width, 16)
                value = words[:, word] >> np.uint64(bit)
                for more in range(1, -(-(bit + width) // 16)):
                    value |= words[:, word + more] << np.uint64(16 * more - bit)
                above = np.uint64(64 - width)
                values[own, k] = ((value << above).view(np.int64) >> above.astype(np.int64)).view(np.uint64)
        row = values.view(np.int64).ravel()[: self.count]
        return np.ascontiguousarray(row.reshape(self.shape[::-1]).T) if self.turned else row.reshape(self.shape)


def _starts(widths: NDArray[np.uint8]) -> tuple[NDArray[np.uint64], int]:
    """Where the words of every fourth run begin, and how many words there are."""
    padded = np.zeros(-(-len(widths) // _RUNS) * _RUNS, np.uint8)
    padded[: len(widths)] = widths
    lengths = padded.reshape(-1, _RUNS).sum(axis=1, dtype=np.uint64)
    ends = np.cumsum(lengths, dtype=np.uint64)
    return ends - lengths, int(ends[-1]) if len(ends) else 0


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
        self._words, self._values = Scratch(device, _WHAT), Scratch(device, _WHAT)
        self._staging = Staging(device)

    def download(self, values: cl.Buffer, shape: tuple[int, ...], start: int = 0, turned: bool = False) -> Narrowed:
        """Integers of a buffer, once all is done that has been enqueued before; valid until the next call.

        Args:
            values: int64.
            shape: of the array that they are.
            start: number of the first of them.
            turned: whether those of a column, which are about as long, go beside each other; of a table alone.
        """
        count = int(np.prod(shape, dtype=np.int64))
        if not count:
            return Narrowed(shape, np.zeros(0, np.uint8), np.zeros(0, np.uint16), turned)
        runs = -(-count // _RUN)
        self._widths.reserve(runs)
        given = {
            "values": values, "start": start, "count": count, "widths": self._widths.buffer,
            **_lying(shape, turned),
        }  # fmt: skip
        self._launch("widths_of", runs, **given)
        widths = self._device.download(self._widths.buffer, (runs,), np.uint8)
        starts, words = _starts(widths)
        self._copy(self._starts, starts)
        self._words.reserve(max(2 * words, 1))
        self._launch("narrow", runs, **given, starts=self._starts.buffer, words=self._words.buffer)
        data = self._staging.download(self._words.buffer, (words,), np.uint16)
        return Narrowed(shape, widths, data, turned)

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
        self._copy(self._words, narrowed.data)
        self._launch(
            "widen",
            narrowed.count,
            values=values,
            count=narrowed.count,
            widths=self._widths.buffer,
            starts=self._starts.buffer,
            words=self._words.buffer,
            **_lying(narrowed.shape, narrowed.turned),
        )

    def narrowed(self, values: NDArray[np.int64]) -> Narrowed:
        """Integers of the host; valid until the next call."""
        self._copy(self._values, values)
        return self.download(self._values.buffer, values.shape)

    def widened(self, narrowed: Narrowed) -> NDArray[np.int64]:
        """Integers for the host, many times as fast as :meth:`Narrowed.widened`.

        Raises:
            ValueError: their parts do not fit each other.
        """
        self._values.reserve(max(8 * narrowed.count, 1))
        self.upload(self._values.buffer, narrowed)
        return self._device.download(self._values.buffer, narrowed.shape, np.int64)

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
        for scratch in (self._widths, self._starts, self._words, self._values):
            scratch.close()
        self._staging.close()


def _lying(shape: tuple[int, ...], turned: bool) -> dict[str, int]:
    """How integers of a table lie, for the kernels."""
    return {"rows": shape[0], "stride": shape[1]} if turned else {"rows": 1, "stride": 0}
