"""Large arrays on their way to a device with memory of its own: :class:`Sending`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host.threads import Ahead
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Staging

#: Arrays of fewer bytes are sent as fast without, and pieces of so many bytes are on their way at a time.
LEAST, PIECE = 1 << 28, 1 << 24
_AT_A_TIME = 6


class Sending(Owner):
    """Sends arrays piece by piece, through memory of the host that drivers copy from without a detour.

    Threads fill it. An NVIDIA driver copies from other memory at a third of the speed, and by one thread alone.

    Args:
        device: that gets them.
        what: they are, for errors.

    Raises:
        DeviceError: the device has no room for a piece.
    """

    def __init__(self, device: Device, what: str) -> None:
        self._device = device
        self._memory = Memory(device)
        self._buffer = self._memory.allocate(PIECE, what)
        self._staging = [Staging(device) for _ in range(_AT_A_TIME)]

    def pieces(self, arrays: Sequence[NDArray[Any]]) -> Iterator[cl.Buffer]:
        """A buffer that begins with the next array, as float32; valid for what is enqueued until the next is asked for.

        Args:
            arrays: of at most :data:`PIECE` bytes each.

        Raises:
            DeviceError: the device failed.
        """
        device = self._device
        sent: list[cl.Event | None] = [None] * _AT_A_TIME

        def fill(number: int) -> NDArray[np.float32]:
            place = number % _AT_A_TIME
            event = sent[place]
            if event is not None:
                event.wait()
            room: NDArray[np.float32] = self._staging[place].array(arrays[number].shape, np.float32)
            np.copyto(room, arrays[number])
            return room

        with Ahead(fill, range(len(arrays)), _AT_A_TIME) as filled:
            for number, array in filled:
                with device.errors("cannot take what is sent"):
                    sent[number % _AT_A_TIME] = cl.enqueue_copy(device.queue, self._buffer, array, is_blocking=False)
                    device.queue.flush()
                yield self._buffer
        with device.errors("cannot take what is sent"):
            device.queue.finish()

    def close(self) -> None:
        """Give all memory back."""
        for staging in self._staging:
            staging.close()
        self._memory.close()
