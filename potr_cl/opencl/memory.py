"""Device memory and who owns it: what is taken together is given back together, also when an error comes between."""

from __future__ import annotations

from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

if TYPE_CHECKING:
    from typing_extensions import Self

    from potr_cl.opencl.device import Device


#: Buffers that are too small are replaced by ones so many times as large as needed.
MARGIN = 1.25


class Owner:
    """Something that holds device memory until it is closed: ``with Rasterizer(…) as rasterizer:``.

    What it has is in its ``_memory``, or in a stack of its own, ``_owned``; or it says in :meth:`close` where.
    """

    _memory: Memory
    _owned: ExitStack

    def close(self) -> None:
        """Give all device memory back; the object is of no use afterwards. Closing twice does no harm."""
        (self._owned if hasattr(self, "_owned") else self._memory).close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Memory(Owner):
    """Buffers of one device that are given back together.

    An owner of buffers makes one, takes all its buffers from it, and closes it when it is closed itself. As a context
    manager it is for buffers that live as long as a block of code::

        with Memory(device) as memory:
            totals = memory.upload(zeros, "the totals")

    Args:
        device: whose memory it is.

    Attributes:
        nbytes: taken and not given back.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._buffers: list[cl.Buffer] = []

    @property
    def nbytes(self) -> int:
        return sum(buffer.size for buffer in self._buffers)

    def allocate(self, nbytes: int, what: str) -> cl.Buffer:
        """A read-write buffer, see :meth:`potr_cl.opencl.device.Device.allocate`."""
        return self.adopt(self._device.allocate(nbytes, what))

    def upload(self, array: np.ndarray[Any, Any], what: str, pending: list[cl.Event] | None = None) -> cl.Buffer:
        """A buffer that holds a copy of ``array``, see :meth:`potr_cl.opencl.device.Device.upload`."""
        return self.adopt(self._device.upload(array, what, pending))

    def adopt(self, buffer: cl.Buffer) -> cl.Buffer:
        """Own a buffer that somebody else took."""
        self._buffers.append(buffer)
        return buffer

    def release(self, buffer: cl.Buffer) -> cl.Buffer:
        """Own a buffer no longer: it is the caller's from now on."""
        self._buffers.remove(buffer)
        return buffer

    def free(self, *buffers: cl.Buffer) -> None:
        """Give single buffers back."""
        for buffer in buffers:
            self._device.free(self.release(buffer))

    def close(self) -> None:
        self.free(*self._buffers)


class Reused(Memory):
    """Buffers that are taken again and again, in the same order and always together.

    To give a driver hundreds of megabytes back and to take them again can take longer than the work between; parts of
    one large buffer are worse, for NVIDIA's driver copies them to the host and back. So the n-th buffer after
    :meth:`close` is the n-th that was taken before, or a larger one in its place. :meth:`give_back` gives all back.

    Args:
        device: whose memory it is.
    """

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self._places: list[Scratch] = []
        self._taken = 0

    @property
    def nbytes(self) -> int:
        return sum(place.nbytes for place in self._places)

    def allocate(self, nbytes: int, what: str) -> cl.Buffer:
        """A buffer of at least so many bytes, see :meth:`potr_cl.opencl.device.Device.allocate`."""
        if self._taken == len(self._places):
            self._places.append(Scratch(self._device, what))
        place = self._places[self._taken]
        if place.buffer is None or place.nbytes < nbytes:  # also for nothing: kernels want a buffer
            place.reserve(max(nbytes, min(int(MARGIN * nbytes), self._device.info.largest_buffer)))
        self._taken += 1
        return place.buffer

    def upload(self, array: np.ndarray[Any, Any], what: str, pending: list[cl.Event] | None = None) -> cl.Buffer:
        """A buffer that begins with a copy of ``array``, see :meth:`potr_cl.opencl.device.Device.upload`."""
        array = np.ascontiguousarray(array)
        buffer = self.allocate(array.nbytes, what)
        if array.nbytes:
            with self._device.errors(f"cannot hold {what}"):
                event = cl.enqueue_copy(self._device.queue, buffer, array, is_blocking=pending is None)
            if pending is not None:
                pending.append(event)
        return buffer

    def free(self, *buffers: cl.Buffer) -> None:
        """Give those back that were adopted; the others are taken again after :meth:`close`."""
        super().free(*(buffer for buffer in buffers if buffer in self._buffers))

    def close(self) -> None:
        super().close()
        self._taken = 0

    def give_back(self) -> None:
        """Give all memory back."""
        self.close()
        for place in self._places:
            place.close()
        self._places = []


class Scratch(Owner):
    """A buffer that grows when asked to, and loses its content then.

    Attributes:
        buffer: the memory. nbytes: its size; 0 before the first :meth:`reserve` and after one that failed.
    """

    def __init__(self, device: Device, what: str) -> None:
        self._device = device
        self._what = what
        self.buffer: cl.Buffer = None
        self.nbytes = 0

    def reserve(self, nbytes: int) -> bool:
        """Have at least ``nbytes``; whether the memory is new.

        Raises:
            DeviceError: the device has no room.
        """
        if self.buffer is not None and self.nbytes >= nbytes:
            return False
        self.close()
        self.buffer = self._device.allocate(nbytes, self._what)
        self.nbytes = nbytes
        return True

    def close(self) -> None:
        """Give the memory back; the next :meth:`reserve` takes new memory."""
        if self.buffer is not None:
            self._device.free(self.buffer)
            self.buffer = None
        self.nbytes = 0


class Staging(Owner):
    """Memory of the host through which much goes to and from a device, again and again.

    Drivers copy from and to it without a detour, and its pages are there from the second time on.

    Args:
        device: that it is for.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._bytes: np.ndarray[Any, Any] | None = None

    def array(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
        """An array in it; what it gave before is overwritten through it."""
        nbytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if self._bytes is None or self._bytes.nbytes < nbytes:
            self._bytes = None
            self._bytes = self._taken(max(nbytes, 16))
        found: np.ndarray[Any, Any] = self._bytes[:nbytes].view(dtype).reshape(shape)
        return found

    def _taken(self, nbytes: int) -> np.ndarray[Any, Any]:
        device = self._device
        if device.info.shares_host_memory:
            return np.empty(nbytes, np.uint8)
        try:
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
            buffer = cl.Buffer(device.context, flags, nbytes)
            access = cl.map_flags.READ | cl.map_flags.WRITE
            # The array keeps the buffer for as long as anybody has it.
            mapped: np.ndarray[Any, Any]
            mapped, _ = cl.enqueue_map_buffer(device.queue, buffer, access, 0, (nbytes,), np.uint8)
        except (cl.Error, MemoryError):  # a driver allows only so much of it
            return np.empty(nbytes, np.uint8)
        return mapped

    def download(self, buffer: cl.Buffer, shape: tuple[int, ...], dtype: Any, start: int = 0) -> np.ndarray[Any, Any]:
        """As :meth:`potr_cl.opencl.device.Device.download`, into this memory."""
        array = self.array(shape, dtype)
        if array.nbytes:
            with self._device.errors("failed while computing"):
                cl.enqueue_copy(self._device.queue, array, buffer, src_offset=start, is_blocking=True)
        return array

    def close(self) -> None:
        """Keep it no longer; arrays in it live on."""
        self._bytes = None
