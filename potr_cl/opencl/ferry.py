"""Large arrays that go between the host and a device with memory of its own again and again: :class:`Ferry`."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Staging

#: Copies of fewer bytes go as fast without that memory, and so do the first ones, until so many bytes have gone:
#: drivers take long to give it. Pieces of so many bytes are on their way at a time.
LEAST, PAYS, PIECE = 1 << 22, 1 << 26, 1 << 24
_AT_A_TIME = 8


@dataclass(frozen=True)
class Cargo:
    """What is copied.

    Attributes:
        values: of one or two dimensions, contiguous.
        start: byte of the buffer where its copy begins.
        columns: some of a matrix's columns; None: all.
    """

    values: NDArray[np.float32]
    start: int = 0
    columns: range | None = None

    @property
    def part(self) -> NDArray[np.float32]:
        """The values that are meant."""
        return self.values if self.columns is None else self.values[:, self.columns.start : self.columns.stop]


class Ferry(Owner):
    """Copies in both directions, piece by piece, through memory of the host that drivers copy from and to directly.

    Threads copy between that and the arrays. From other memory an NVIDIA driver copies at a third of the speed or less,
    by one thread alone, and slower yet where a file is mapped there. What shares the host's memory is copied at once.

    Args:
        device: that has the buffers.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._direct = device.info.shares_host_memory
        self._places = max(min(os.cpu_count() or 1, _AT_A_TIME), 2)
        #: By so many pieces the threads are ahead of the device, or behind it.
        self._lag = self._places // 2
        self._staging = [Staging(device) for _ in range(self._places)]
        #: What was sent from each place last, if that may still be on its way.
        self._sent: list[cl.Event | None] = [None] * self._places
        self._turn = self._gone = 0
        self._threads: ThreadPoolExecutor | None = None

    def to_device(self, buffer: cl.Buffer, cargo: Sequence[Cargo], pitch: int = 0) -> None:
        """Enqueue copies to a buffer; the arrays may change as soon as it returns.

        Args:
            buffer: that they go to.
            cargo: what goes.
            pitch: bytes from row to row in the buffer; 0: they lie close.

        Raises:
            DeviceError: the device failed.
        """
        if self._few(cargo):
            for each in cargo:
                self._copy_at_once(buffer, each, pitch, to_device=True)
            return
        pieces = [piece for each in cargo for piece in _pieces(each.part, each.start, pitch)]
        filling: deque[tuple[int, Future[NDArray[np.float32]]]] = deque()
        for number in range(len(pieces) + self._lag):
            if number < len(pieces):
                place = self._place()
                event, self._sent[place] = self._sent[place], None
                if event is not None:
                    self._wait_for(event)
                filling.append((place, self._in_thread(self._fill, place, pieces[number][0])))
            if number >= self._lag:
                place, filled = filling.popleft()
                start = pieces[number - self._lag][1]
                self._sent[place] = self._copy(buffer, filled.result(), start, pitch, to_device=True)

    def to_host(self, cargo: Sequence[Cargo], buffer: cl.Buffer, pitch: int = 0) -> None:
        """Copy from a buffer: :meth:`to_device` the other way round. The arrays have it when it returns."""
        if self._few(cargo):
            for each in cargo:
                self._copy_at_once(buffer, each, pitch, to_device=False)
            return
        pieces = [piece for each in cargo for piece in _pieces(each.part, each.start, pitch)]
        arriving: list[tuple[NDArray[np.float32], cl.Event]] = []
        taken: list[Future[None]] = []
        for number in range(len(pieces) + self._lag):
            if number < len(pieces):
                if number >= self._places:
                    taken[number - self._places].result()
                own, start = pieces[number]
                # What is still sent from there comes before, in the queue.
                array = self._staging[self._place()].array(own.shape, np.float32)
                arriving.append((array, self._copy(buffer, array, start, pitch, to_device=False)))
            if number >= self._lag:
                array, event = arriving[number - self._lag]
                self._wait_for(event)
                taken.append(self._in_thread(np.copyto, pieces[number - self._lag][0], array))
        for future in taken:
            future.result()

    def _place(self) -> int:
        self._turn = (self._turn + 1) % self._places
        return self._turn

    def _wait_for(self, event: cl.Event) -> None:
        with self._device.errors("failed while computing"):
            event.wait()

    def _few(self, cargo: Sequence[Cargo]) -> bool:
        nbytes = sum(each.part.nbytes for each in cargo)
        self._gone += nbytes
        return self._direct or nbytes < LEAST or self._gone < PAYS

    def _in_thread(self, work: Any, *args: Any) -> Future[Any]:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(self._places)
        return self._threads.submit(work, *args)

    def _fill(self, place: int, values: NDArray[np.float32]) -> NDArray[np.float32]:
        array: NDArray[np.float32] = self._staging[place].array(values.shape, np.float32)
        np.copyto(array, values)
        return array

    def _copy(
        self, buffer: cl.Buffer, values: NDArray[np.float32], start: int, pitch: int, to_device: bool
    ) -> cl.Event:
        """Enqueue a copy of a whole array, or to one."""
        queue, close = self._device.queue, values.ndim == 1 or pitch in (0, values.strides[0])
        pair = (buffer, values) if to_device else (values, buffer)
        with self._device.errors("failed while computing"):
            if close:
                where = {"dst_offset" if to_device else "src_offset": start}
                event = cl.enqueue_copy(queue, *pair, is_blocking=False, **where)
            else:
                event = cl.enqueue_copy(
                    queue, *pair, is_blocking=False, **_rectangle(values, start, pitch, range(values.shape[1]))
                )
            queue.flush()
        return event

    def _copy_at_once(self, buffer: cl.Buffer, cargo: Cargo, pitch: int, to_device: bool) -> None:
        values, queue = cargo.values, self._device.queue
        pair = (buffer, values) if to_device else (values, buffer)
        with self._device.errors("failed while computing"):
            if values.ndim == 1:
                where = {"dst_offset" if to_device else "src_offset": cargo.start}
                cl.enqueue_copy(queue, *pair, is_blocking=True, **where)
            else:
                columns = range(values.shape[1]) if cargo.columns is None else cargo.columns
                cl.enqueue_copy(queue, *pair, is_blocking=True, **_rectangle(values, cargo.start, pitch, columns))

    def close(self) -> None:
        """Give the memory back."""
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None
        for event in self._sent:
            if event is not None:
                with suppress(cl.Error):  # a device that has failed: whoever looks at its results is told
                    event.wait()
        self._sent = [None] * self._places
        for staging in self._staging:
            staging.close()


def _pieces(values: NDArray[np.float32], start: int, pitch: int) -> Iterator[tuple[NDArray[np.float32], int]]:
    """Parts of an array of at most :data:`PIECE` bytes, and where they begin in the buffer."""
    if values.ndim == 1:
        for first in range(0, len(values), PIECE // 4):
            yield values[first : first + PIECE // 4], start + 4 * first
        return
    width = values.shape[1]
    pitch = pitch or 4 * width
    if 4 * width > PIECE:
        for row, own in enumerate(values):
            yield from _pieces(own, start + row * pitch, 0)
        return
    rows = max(PIECE // (4 * width), 1)
    for first in range(0, len(values), rows):
        yield values[first : first + rows], start + first * pitch


def _rectangle(values: NDArray[np.float32], start: int, pitch: int, columns: range) -> dict[str, Any]:
    """How some columns of a matrix lie in it and in a buffer, as a copy takes it."""
    pitch = pitch or 4 * len(columns)
    return {
        "buffer_origin": (start % pitch, start // pitch, 0),
        "host_origin": (4 * columns.start, 0, 0),
        "region": (4 * len(columns), len(values), 1),
        "buffer_pitches": (pitch, 0),
        "host_pitches": (values.strides[0], 0),
    }
