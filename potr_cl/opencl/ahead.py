"""Devices that are opened before it is known for sure that somebody needs them: :func:`begin_to_open`; or were before.

A driver takes as long to load and to open a device as a command's modules take to be imported. Both can be done at the
same time, because neither keeps other threads waiting.

Drivers never give back all that they take for a context and its programs, so a process that opens a device again and
again would grow: one context of each device is left for whoever opens it next (:func:`leave`).
"""

from __future__ import annotations

import gc
import threading
from collections import defaultdict, deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import TypeAlias

import pyopencl as cl

from potr_cl.errors import DeviceError
from potr_cl.host.threads import in_background
from potr_cl.opencl.discovery import DeviceInfo, choose_devices, list_devices
from potr_cl.opencl.loader import new_context

#: Programs by source and options.
Programs: TypeAlias = "dict[tuple[str, tuple[str, ...]], cl.Program]"

_lock = threading.Lock()
_begun: Future[list[tuple[DeviceInfo, cl.Context]]] | None = None
_opened: set[cl.Device] = set()
_left: defaultdict[cl.Device, deque[tuple[cl.Context, Programs]]] = defaultdict(lambda: deque(maxlen=1))


def begin_to_open(spec: str | None, whole: bool = True) -> None:
    """Have a thread load the drivers, and make contexts of the devices that will probably be asked for.

    Args:
        spec: as of :func:`potr_cl.opencl.discovery.choose_devices`. Whoever asks for the devices is told what is wrong
            with them; here they are left alone then.
        whole: make contexts; if not, only the drivers are loaded.
    """
    global _begun
    with _lock:
        _begun = in_background(_open, spec, whole)


def _open(spec: str | None, whole: bool) -> list[tuple[DeviceInfo, cl.Context]]:
    list_devices()
    if whole:
        with suppress(DeviceError, cl.Error):
            chosen = choose_devices(spec)
            with ThreadPoolExecutor(len(chosen)) as threads:  # drivers take long to open one
                return list(zip(chosen, threads.map(lambda each: new_context(each.handle), chosen), strict=True))
    return []


def leave(handle: cl.Device, context: cl.Context, programs: Programs) -> None:
    """Leave a context that works, and of which nobody uses anything any more. Called by the garbage collection."""
    _left[handle].append((context, programs))


def context_of(info: DeviceInfo) -> tuple[cl.Context, Programs]:
    """A context of a device: the one that was left or begun, where that is of this device and nobody has it yet.

    Returns:
        It, and what has been built for it.

    Raises:
        pyopencl.Error: there is none to be had.
    """
    if info.handle in _opened and not _left[info.handle]:
        gc.collect()  # devices and their kernels know each other
    _opened.add(info.handle)
    with suppress(IndexError):
        return _left[info.handle].pop()
    with _lock:
        begun = _begun
    ready = [] if begun is None else begun.result()
    with _lock:
        for place, (its_info, _) in enumerate(ready):
            if its_info.handle == info.handle:
                return ready.pop(place)[1], {}
    return new_context(info.handle), {}
