"""Batches of splats on their way to the device and back, while it works on another batch."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner


class Slot(Owner):
    """Device memory and a queue for one batch of splats.

    Two slots take turns, so that the host fills one while the device works on the other. GPUs copy from and to pinned
    memory, which they do on their own and several times as fast as from ordinary memory; CPUs copy from where data lie.

    Args:
        device: to which the batches go.
        sizes: bytes of each buffer and what it holds, by name. The first is the one that comes back.
        pinned: whether to copy by way of pinned memory.

    Attributes:
        buffers: by name. queue: that fills them and fetches the first one.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(self, device: Device, sizes: Mapping[str, tuple[int, str]], pinned: bool) -> None:
        self._device = device
        self._memory = Memory(device)
        self._target: FloatArray | None = None
        self._compacted: FloatArray | None = None
        self._copied: Future[None] | None = None
        self._events: list[cl.Event] = []  # letting go of one waits for it
        self._mapped: dict[str, NDArray[np.uint8]] = {}
        self._fetched: NDArray[np.uint8] | None = None
        self._maps: list[cl.MemoryMap] = []
        self._result = next(iter(sizes))
        with device.all_or_nothing(), device.errors("cannot hold the splats to compact"):
            self.queue = device.queue
            if device.several_queues:
                self.queue = cl.CommandQueue(device.context, device.info.handle, properties=device.queue.properties)
            self.buffers = {name: self._memory.allocate(nbytes, what) for name, (nbytes, what) in sizes.items()}
            if pinned:
                self._mapped = {name: self._pinned(nbytes) for name, (nbytes, _) in sizes.items()}
                # Results are fetched while the next batch is filled in.
                self._fetched = self._pinned(sizes[self._result][0])

    def _pinned(self, nbytes: int) -> NDArray[np.uint8]:
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        buffer = cl.Buffer(self._device.context, flags, nbytes)
        access = cl.map_flags.READ | cl.map_flags.WRITE
        mapped: NDArray[np.uint8] = cl.enqueue_map_buffer(self.queue, buffer, access, 0, (nbytes,), np.uint8)[0]
        self._maps.append(mapped.base)
        return mapped

    def _staged(self, name: str, array: NDArray[Any]) -> NDArray[Any]:
        """The array where the device copies it from."""
        if not self._mapped:
            return np.ascontiguousarray(array)
        staged = self._mapped[name][: array.nbytes].view(array.dtype).reshape(array.shape)
        np.copyto(staged, array)
        return staged

    def upload(self, arrays: Mapping[str, NDArray[Any]], pool: ThreadPoolExecutor) -> None:
        """Fill the buffers of these names."""
        staged = pool.map(self._staged, arrays.keys(), arrays.values())
        with self._device.errors("failed to take the splats to compact"):
            for name, array in zip(arrays, staged, strict=True):
                if array.nbytes:
                    self._events.append(cl.enqueue_copy(self.queue, self.buffers[name], array, is_blocking=False))
            self.queue.flush()

    def download(self, target: FloatArray) -> None:
        """Begin to fetch the first buffer to a contiguous array; :meth:`collect` ends it."""
        if self._copied is not None:
            self._copied.result()
        self._target = self._compacted = target
        if self._fetched is not None:
            self._compacted = self._fetched[: target.nbytes].view(np.float32).reshape(target.shape)
        source = self.buffers[self._result]
        with self._device.errors("failed while computing"):
            self._events.append(cl.enqueue_copy(self.queue, self._compacted, source, is_blocking=False))
            self.queue.flush()

    def collect(self, pool: ThreadPoolExecutor) -> None:
        """Wait for what :meth:`download` began. The target is complete once the pool is."""
        if self._target is None or self._compacted is None:
            return
        with self._device.errors("failed while computing"):
            self.queue.finish()
        self._events.clear()
        if self._fetched is not None:
            self._copied = pool.submit(np.copyto, self._target, self._compacted)
        self._target = None

    def close(self) -> None:
        with contextlib.suppress(cl.Error):
            self.queue.finish()
        self._events.clear()
        for mapped in self._maps:
            mapped.release(self.queue)
        self._maps.clear()
        self._memory.close()
