"""Devices that are smaller than they say, to try what other devices would do: :func:`limited`.

The environment variable :data:`LIMITS_VARIABLE` names what every device has no more of, as
``memory=4,buffer=1,kernel=0.25,profiling=no,shared=yes`` (any of them; GB and seconds).
"""

from __future__ import annotations

import dataclasses
import os
from typing import TYPE_CHECKING

import pyopencl as cl

from potr_cl.errors import DeviceError

if TYPE_CHECKING:
    from potr_cl.opencl.discovery import DeviceInfo

LIMITS_VARIABLE = "POTR_CL_DEVICE_LIMITS"
#: Seconds that a kernel may take where a watchdog may end it. Those of displays wait two seconds.
WATCHED = 0.25
#: cl_nv_device_attribute_query: whether the driver ends kernels that run for long.
_KERNEL_EXEC_TIMEOUT_NV = 0x4006


def longest_kernel(kind: str, handle: cl.Device) -> float | None:
    """Seconds that one kernel may take on a device; None: as many as it needs.

    NVIDIA's drivers say whether a watchdog runs. Of other GPUs nobody knows, so one is expected.
    """
    if kind != "gpu":
        return None
    try:
        watched = (
            bool(handle.get_info(_KERNEL_EXEC_TIMEOUT_NV))
            if "cl_nv_device_attribute_query" in handle.extensions
            else True
        )
    except cl.Error:
        watched = True
    return WATCHED if watched else None


def limited(info: DeviceInfo) -> DeviceInfo:
    """The device with no more than :data:`LIMITS_VARIABLE` allows.

    Raises:
        DeviceError: the variable is not to be understood.
    """
    limits = _limits(os.environ.get(LIMITS_VARIABLE, ""))
    memory = min(int(limits.get("memory", float("inf")) * 1e9), info.memory) if "memory" in limits else info.memory
    buffer = int(limits["buffer"] * 1e9) if "buffer" in limits else info.largest_buffer
    return dataclasses.replace(
        info,
        memory=memory,
        largest_buffer=min(buffer, info.largest_buffer, memory),
        longest_kernel=limits.get("kernel", info.longest_kernel),
        profiling=info.profiling and bool(limits.get("profiling", True)),
        integrated=info.integrated or bool(limits.get("shared", False)),
    )


def _limits(text: str) -> dict[str, float]:
    numbers, words = ("memory", "buffer", "kernel"), {"yes": 1.0, "no": 0.0}
    found: dict[str, float] = {}
    for part in filter(None, (each.strip() for each in text.split(","))):
        name, _, value = part.partition("=")
        try:
            found[name] = float(value) if name in numbers else words[value]
            known = found[name] > 0 if name in numbers else name in ("profiling", "shared")
        except (KeyError, ValueError):
            known = False
        if not known:
            raise DeviceError(
                f"{LIMITS_VARIABLE} has '{part}': give memory=GB, buffer=GB, kernel=SECONDS, profiling=no or "
                "shared=yes, with commas between them"
            )
    return found
