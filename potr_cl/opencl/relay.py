"""From the memory of one device of this computer to that of another: :class:`Relay`, and what it takes, :class:`Lent`.

Devices that were opened apart share no memory, so what goes from one to the other goes through the host, in slices:
while one slice arrives, the next one is on its way. Memory that a driver knows (:class:`potr_cl.opencl.memory.Staging`)
makes that several times as fast as a download and an upload of everything.
"""

from __future__ import annotations

import threading
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Staging

#: Bytes of a slice, and slices that the host has room for.
_SLICE, _SLOTS = 1 << 23, 3
#: Room of relays that are closed: to take memory that a driver knows takes long. By the device that they were for.
_spare: WeakKeyDictionary[Device, list[Any]] = WeakKeyDictionary()
_sparing = threading.Lock()


class Lent:
    """A part of a device's memory for others of this process to read, as it will be once all before it is done.

    Who lends it does not change it before the others have said that they have it.

    Args:
        device: whose memory it is.
        buffer: is read from its beginning on.
        nbytes: of it that are lent.

    Attributes:
        device, buffer, nbytes: as given.
        ready: when the content is there.
    """

    def __init__(self, device: Device, buffer: cl.Buffer, nbytes: int) -> None:
        self.device, self.nbytes = device, nbytes
        self.lend(buffer)

    def lend(self, buffer: cl.Buffer) -> None:
        """Lend another buffer in its place, with the same content."""
        self.buffer = buffer
        with self.device.errors("failed while computing"):
            self.ready = done_so_far(self.device)


class Relay(Owner):
    """Copies what is lent to one device.

    Args:
        device: that receives.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._queue = _queue_beside(device)
        self._queues: dict[Device, Any] = {}
        # Taken now: a device that computes would be waited for. Any driver copies fast to and from memory of another.
        self._slots = _room(device)

    def fetch(
        self,
        target: cl.Buffer,
        lent: Lent,
        start: int = 0,
        nbytes: int | None = None,
        free: cl.Event | None = None,
    ) -> None:
        """Copy what is lent, or a part of it, to the beginning of a buffer; it is there when the method returns.

        Args:
            target: on this device.
            lent: by another device, or by this one.
            start: first byte of the part.
            nbytes: of the part; None: all that follow.
            free: when nobody looks any more at what the target held, see :func:`done_so_far`; None: when all is done
                that has been enqueued on this device before.

        Raises:
            DeviceError: a device failed.
        """
        nbytes = lent.nbytes - start if nbytes is None else nbytes
        if not nbytes:
            return
        device = self._device
        with device.errors("failed while computing"):
            # Kernels that were enqueued before may still look at what the target held.
            free = free or done_so_far(device)
            if lent.device is device:
                waits = [free, lent.ready]
                cl.enqueue_copy(
                    self._queue, target, lent.buffer, byte_count=nbytes, src_offset=start, wait_for=waits
                ).wait()
            else:
                self._through_host(target, lent, start, nbytes, free)

    def _through_host(self, target: cl.Buffer, lent: Lent, start: int, nbytes: int, free: cl.Event) -> None:
        if lent.device not in self._queues:
            self._queues[lent.device] = _queue_beside(lent.device)
        departing, slots = self._queues[lent.device], self._slots
        sizes = [min(_SLICE, nbytes - first) for first in range(0, nbytes, _SLICE)]
        down: list[cl.Event] = []
        up: list[cl.Event] = []

        def depart(number: int) -> None:
            if number >= _SLOTS:
                up[number - _SLOTS].wait()
            slot, first = slots[number % _SLOTS][: sizes[number]], start + number * _SLICE
            waits = None if number else [lent.ready]
            with lent.device.errors("failed while computing"):
                copied = cl.enqueue_copy(
                    departing, slot, lent.buffer, src_offset=first, is_blocking=False, wait_for=waits
                )
                down.append(copied)
                departing.flush()

        def land(number: int) -> None:
            with lent.device.errors("failed while computing"):
                down[number].wait()
            slot, first = slots[number % _SLOTS][: sizes[number]], number * _SLICE
            waits = None if number else [free]
            up.append(cl.enqueue_copy(self._queue, target, slot, dst_offset=first, is_blocking=False, wait_for=waits))
            self._queue.flush()

        try:
            # One slot less is under way than there are: who waits for a slot waits for the copy before the last.
            ahead = _SLOTS - 1
            for number in range(len(sizes) + ahead):
                if number < len(sizes):
                    depart(number)
                if number >= ahead:
                    land(number - ahead)
        finally:
            # What is on its way uses memory that must not be given up.
            departing.finish()
            self._queue.finish()

    def close(self) -> None:
        """Leave the host's memory to the device's next relay; this one is of no use afterwards."""
        slots, self._slots = self._slots, np.empty((0, 0), np.uint8)
        if slots.size:
            with _sparing:
                _spare.setdefault(self._device, []).append(slots)
        self._queues = {}


def _room(device: Device) -> Any:
    """(slots, bytes) uint8 of the host, that a closed relay of the device has left, or new."""
    with _sparing:
        spare = _spare.get(device, [])
        while spare:
            slots = spare.pop()
            if slots.shape == (_SLOTS, _SLICE):
                return slots
    return Staging(device).array((_SLOTS, _SLICE), np.uint8)


def done_so_far(device: Device) -> cl.Event:
    """When all is done that has been enqueued on a device's own queue; other queues can wait for it."""
    event = cl.enqueue_marker(device.queue)
    device.queue.flush()
    return event


def _queue_beside(device: Device) -> Any:
    """A queue on which something is copied while the device's own is busy, where the driver can do that."""
    if not device.several_queues:
        return device.queue
    with device.errors("cannot be opened"):
        return cl.CommandQueue(device.context, device.info.handle)
