"""If a scene does not fit a device (:func:`with_fallback`): keep less in its memory, then let a CPU do the work."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import TypeVar

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.views.budget import default_memory
from potr_cl.views.visibility import LEAST_SPLATS

logger = logging.getLogger("potr_cl")

T = TypeVar("T")

#: After the first failure, views get this many times less memory. After the second, none is kept at all.
_LESS = 8


def with_fallback(device: Device, memory: int | None, work: Callable[[Device, int | None], T]) -> tuple[T, Device]:
    """Do work that may not fit a device: if it does not, with less memory, and in the end on a CPU.

    A warning says so each time.

    Args:
        device: the first to be tried.
        memory: how many bytes of its memory may be filled with views; None: :func:`default_memory`.
        work: is given the device, and the bytes.

    Returns:
        What the work returned, and the device that it was done on.

    Raises:
        DeviceMemoryError: the work fits no device that there is.
        DeviceError: the device failed for another reason.
    """
    ways = _ways(device, memory)
    way = next(ways)
    while True:
        opened, room = way
        try:
            # A failure may leave buffers behind that nobody owns any more.
            with opened.all_or_nothing(), opened.errors("failed while encoding"):
                return work(opened, room), opened
        except DeviceMemoryError:
            following = next(ways, None)
            if following is None:
                raise
            way = following


def _ways(device: Device, memory: int | None) -> Iterator[tuple[Device, int | None]]:
    yield from _with_less(device, memory)
    if device.info.kind == "cpu":
        return
    try:
        other = choose_device("cpu")
    except DeviceError:
        return
    logger.warning("device %s has too little memory for this scene: going on with %s", device.info, other)
    yield from _with_less(Device(other), memory)


def _with_less(device: Device, memory: int | None) -> Iterator[tuple[Device, int | None]]:
    yield device, memory
    for less in ((default_memory(device) if memory is None else memory) // _LESS, 0):
        megabytes = less // 1_000_000
        logger.warning("device %s ran out of memory: again with %d MB to keep views in", device.info, megabytes)
        yield device, less


#: Bytes of the host's memory for each splat: what is not mapped of the scene (44), and what pruning knows of the splats
#: while it chooses among them, as measured with 2.5 and 10 million. And what the interpreter and compilers take.
_SPLAT, _PROCESS = 220, 1 << 28
#: Views get this part of the memory in any case.
_LEAST = 1 / 4


def for_views(device: Device, memory: int | None, splats: int) -> int | None:
    """How many bytes of a device's memory views may fill, of those that a whole encode may take.

    Args:
        device: where its memory is the host's, a large scene's arrays share it. A GPU's memory is its own.
        memory: bytes that are allowed; None: nothing was said.
        splats: of the scene. Of small ones the views take nearly all.
    """
    of_host = device.info.shares_host_memory
    if memory is None or not of_host or splats < LEAST_SPLATS:
        return memory
    return max(memory - _PROCESS - _SPLAT * splats, int(_LEAST * memory))
