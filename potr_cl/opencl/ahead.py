"""A device that is opened before it is known for sure that somebody needs it: :func:`begin_to_open`.

A driver takes as long to load and to open a device as a command's modules take to be imported. Both can be done at the
same time, because neither keeps other threads waiting.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future
from contextlib import suppress

import pyopencl as cl

from potr_cl.errors import DeviceError
from potr_cl.host.threads import in_background
from potr_cl.opencl.discovery import DeviceInfo, choose_devices, list_devices
from potr_cl.opencl.loader import new_context

_lock = threading.Lock()
_begun: Future[tuple[DeviceInfo, cl.Context] | None] | None = None


def begin_to_open(spec: str | None, whole: bool = True) -> None:
    """Have a thread load the drivers, and make a context of the device that will probably be asked for.

    Args:
        spec: as of :func:`potr_cl.opencl.discovery.choose_devices`. Whoever asks for the device is told what is wrong
            with it; here it is left alone then, and so are several.
        whole: make a context; if not, only the drivers are loaded.
    """
    global _begun
    with _lock:
        _begun = in_background(_open, spec, whole)


def _open(spec: str | None, whole: bool) -> tuple[DeviceInfo, cl.Context] | None:
    list_devices()
    if whole:
        with suppress(DeviceError, cl.Error):
            chosen = choose_devices(spec)
            if len(chosen) == 1:
                return chosen[0], new_context(chosen[0].handle)
    return None


def context_of(info: DeviceInfo) -> cl.Context:
    """A context of a device: the one that was begun, where that is of this device and nobody has it yet.

    Raises:
        pyopencl.Error: there is none to be had.
    """
    global _begun
    with _lock:
        begun, _begun = _begun, None
    ready = None if begun is None else begun.result()
    return ready[1] if ready is not None and ready[0].handle == info.handle else new_context(info.handle)
