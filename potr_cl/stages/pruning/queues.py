"""Pieces of work that do not depend on each other, dealt out to several command queues of a device."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import TypeVar

import pyopencl as cl

from potr_cl.opencl.device import Device

T = TypeVar("T")


class Queues:
    """The device's own queue, or several others.

    Args:
        device: that the work is for.
        most: queues to open, where the device takes more than its own.
    """

    def __init__(self, device: Device, most: int) -> None:
        self._device = device
        self._queues = [device.queue]
        if most > 1 and device.several_queues:
            properties = device.queue.properties
            self._queues = [cl.CommandQueue(device.context, device.info.handle, properties) for _ in range(most)]

    def dealt(self, work: Iterable[T]) -> Iterator[tuple[T, cl.CommandQueue]]:
        """Each piece of work with the queue that it goes to, after what the device's own has; :meth:`wait` for all."""
        self._device.queue.finish()
        for piece, queue in zip(work, itertools.cycle(self._queues)):
            yield piece, queue
            queue.flush()

    def wait(self) -> None:
        """Return once all is done.

        Raises:
            DeviceError: the device failed.
        """
        with self._device.errors("failed while computing"):
            for queue in self._queues:
                queue.finish()
