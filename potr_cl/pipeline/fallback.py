"""If a scene does not fit a device (:func:`on_device`): keep less in its memory, then let a CPU do the work."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.views.budget import default_memory

logger = logging.getLogger("potr_cl")

T = TypeVar("T")

#: After the first failure, views get this many times less memory. After the second, none is kept at all.
_LESS = 8


def on_device(device: Device, memory: int | None, work: Callable[[Device, int | None], T]) -> tuple[T, Device]:
    """Do work that may not fit a device. If it does not, repeat it with less memory, and in the end on a CPU.

    A warning says so each time.

    Args:
        device: the first to be tried.
        memory: how many bytes of its memory may be filled with views; None: :func:`default_memory`.
        work: called with the device and that number of bytes, and again after a DeviceMemoryError.

    Returns:
        What ``work`` returned, and the device that it was done on.

    Raises:
        DeviceMemoryError: it fits no device that there is.
        DeviceError: the device failed for another reason.
    """
    try:
        return _with_less(device, memory, work), device
    except DeviceMemoryError:
        if device.info.kind == "cpu":
            raise
        try:
            other = choose_device("cpu")
        except DeviceError:
            other = None
        if other is None:
            raise
    logger.warning("device %s has too little memory for this scene: going on with %s", device.info, other)
    device = Device(other)
    return _with_less(device, memory, work), device


def _with_less(device: Device, given: int | None, work: Callable[[Device, int | None], T]) -> T:
    less = (default_memory(device) if given is None else given) // _LESS
    for memory, smaller in ((given, less), (less, 0), (0, None)):
        try:
            # A failure may leave buffers behind that nobody owns any more.
            with device.all_or_nothing(), device.errors("failed while encoding"):
                return work(device, memory)
        except DeviceMemoryError:
            if smaller is None:
                raise
            megabytes = smaller // 1_000_000
            logger.warning("device %s ran out of memory: again with %d MB to keep views in", device.info, megabytes)
    raise AssertionError("the last budget returns or raises")
