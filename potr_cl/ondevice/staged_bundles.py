"""Bundles of a file on their way to a device: :class:`StagedBundles`.

A bundle's values are packed into memory that the driver copies from without a detour, while other bundles are decoded;
that memory stays with the device from one file to the next. On the device a kernel spreads them over the scene's
columns. So neither the host nor the bus handles the AC coefficients that are 0, which most are.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from potr_cl.codec.native.values import BUNDLE, PACKED, PackedValues
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Staging
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

_SOURCE = "ondevice/spread.cl"
#: Bundles that may be decoded, or wait to be copied, at a time; and those whose memory stays with a device.
_MOST_ROOMS = 24


class Room(PackedValues):
    """Memory for a bundle.

    Attributes:
        copied: when the device has a copy of what is in it; None: nothing waits for it.
    """

    def __init__(self, device: Device) -> None:
        super().__init__(Staging(device).array((PACKED,), np.float32))
        self.copied: cl.Event | None = None


class StagedBundles(Owner):
    """Uploads the packed values of bundles into a scene's buffers.

    Args:
        buffers: to be filled.
        lock: held by whoever tells the device what to do.

    Raises:
        DeviceError: the device has no room for a bundle beside the scene.
    """

    def __init__(self, buffers: SceneBuffers, lock: threading.Lock) -> None:
        device = buffers.device
        self._buffers, self._lock = buffers, lock
        self._rooms = _taken(device)
        self._number = len(self._rooms)
        self._memory = Memory(device)
        try:
            self._packed = self._memory.allocate(4 * PACKED, "a bundle of splats")
            # Under the lock it is used by other threads than this one, which decodes until they are done.
            self._spread = device.shared_kernel(_SOURCE, "spread", BUNDLE=BUNDLE)
        except BaseException:
            self.close()
            raise
        self._spread.bind(
            packed=self._packed,
            splats=0,
            items=0,
            first=0,
            stride=buffers.stride,
            scales=buffers.scales,
            quaternions=buffers.quaternions,
            log2_opacities=buffers.log2_opacities,
            sh=buffers.sh,
        )

    @contextmanager
    def room(self) -> Iterator[PackedValues]:
        """Memory for a bundle, which is its caller's meanwhile."""
        room = self._free_room()
        try:
            yield room
        finally:
            self._rooms.append(room)

    def _free_room(self) -> Room:
        device = self._buffers.device
        try:
            room = self._rooms.popleft()
        except IndexError:
            self._number += 1
            return Room(device)
        if room.copied is None:
            return room
        if self._number < _MOST_ROOMS and not _is_done(room.copied):
            self._rooms.append(room)
            self._number += 1
            return Room(device)
        with device.errors("failed while decoding"):
            room.copied.wait()
        room.copied = None
        return room

    def take(self, first: int, packed: PackedValues, items: int) -> None:
        """Upload a bundle and spread it, in the order of the queue.

        Args:
            first: the number of its first splat.
            packed: of :meth:`room`.
            items: how many it has.

        Raises:
            DeviceError: the device failed.
        """
        buffers, device = self._buffers, self._buffers.device
        splats = min(buffers.splats - first, BUNDLE)
        used = packed.used(items)
        with self._lock:
            with device.errors("cannot take a scene"):
                event = cl.enqueue_copy(device.queue, self._packed, packed.memory[:used], is_blocking=False)
            if isinstance(packed, Room):
                packed.copied = event
            self._spread.set(splats=splats, items=items, first=first)
            groups = -(-max(splats, items) // SPLAT_GROUP)
            self._spread.launch((groups * SPLAT_GROUP,), (SPLAT_GROUP,))
            device.queue.flush()

    def close(self) -> None:
        """Once the device has done everything: keep some memory for the next file."""
        for room in self._rooms:
            room.copied = None
        _kept(self._buffers.device, self._rooms)
        self._rooms = deque()
        self._memory.close()


#: Memory that no file is decoded to now, by device.
_free: WeakKeyDictionary[Device, deque[Room]] = WeakKeyDictionary()
_guard = threading.Lock()


def _taken(device: Device) -> deque[Room]:
    with _guard:
        return _free.pop(device, deque())


def _kept(device: Device, rooms: deque[Room]) -> None:
    with _guard:
        kept = _free.setdefault(device, deque())
        kept.extend(room for room, _ in zip(rooms, range(_MOST_ROOMS - len(kept)), strict=False))


def _is_done(event: cl.Event) -> bool:
    return bool(event.command_execution_status <= cl.command_execution_status.COMPLETE)
