"""Which OpenCL devices there are, and which to take."""

from __future__ import annotations

import logging
import os
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from platform import machine
from typing import Literal

import pyopencl as cl

from potr_cl.errors import DeviceError
from potr_cl.host.libraries import install_command
from potr_cl.opencl import compiler, limits, loader, quirks, verdict

Family = Literal["cpu", "gpu"]

logger = logging.getLogger("potr_cl")

#: Environment variable that stands in for ``--device``.
DEVICE_VARIABLE = "POTR_CL_DEVICE"


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device and what matters about it.

    Attributes:
        index: position in :func:`list_devices`; what ``--device INDEX`` means.
        name, platform, version: as the driver spells them; ``version`` is the platform's.
        kind: "gpu", "cpu" or "accelerator".
        integrated: a GPU that shares the host's memory.
        memory: bytes of global memory. largest_buffer: bytes that one buffer may have.
        local_memory: bytes of local memory a work-group.
        compute_units: as the driver counts them.
        vector_width: floats in the native vector (1 where scalar code is what the device wants).
        max_work_group: work-items that fit one work-group.
        family: which kernels it will run: "gpu" (a work-group a tile) or "cpu" (row vectors).
        longest_kernel: seconds that a kernel may take before a watchdog might end it; None: as long as it likes.
        profiling: whether the device measures times.
        handle: the pyopencl device.
    """

    index: int
    name: str
    platform: str
    version: str
    kind: Literal["gpu", "cpu", "accelerator"]
    integrated: bool
    memory: int
    largest_buffer: int
    local_memory: int
    compute_units: int
    vector_width: int
    max_work_group: int
    family: Family
    longest_kernel: float | None
    profiling: bool
    handle: cl.Device

    @property
    def shares_host_memory(self) -> bool:
        """Whether the device's memory is the host's: a CPU, or a GPU beside one."""
        return self.kind == "cpu" or self.integrated

    @property
    def indexes_in_memory(self) -> bool:
        """Whether private arrays that are indexed at run time lie in its memory: on AMD's GPUs, far from registers."""
        return self.kind == "gpu" and any(name in self.handle.vendor for name in ("AMD", "Advanced Micro Devices"))

    def __str__(self) -> str:
        return f"'{self.name}' ({self.platform})"


_devices: list[DeviceInfo] | None = None
_listing = threading.Lock()


def list_devices() -> list[DeviceInfo]:
    """All usable OpenCL devices, in the order of the platforms.

    Platforms that fail to answer or have no device are left out, each with a warning or silently as they deserve. The
    first call loads the drivers; other threads go on meanwhile.
    """
    global _devices
    with _listing:
        if _devices is None:
            _devices = list(_find_devices())
    return list(_devices)


def _find_devices() -> Iterator[DeviceInfo]:
    loader.register_runtimes()
    loader.load_drivers()
    try:
        platforms = cl.get_platforms()
    except cl.Error as error:  # the loader's way of saying that there is none
        logger.debug("no OpenCL platform: %s", error)
        return
    index = 0
    for platform in platforms:
        try:
            handles = platform.get_devices()
        except cl.Error as error:
            logger.debug("OpenCL platform without a device: %s", error)
            continue
        for handle in handles:
            try:
                info = limits.limited(_describe(index, platform, handle))
            except cl.Error as error:
                logger.warning("leaving out an OpenCL device that cannot be queried: %s", error)
                continue
            if handle.available and handle.compiler_available:
                yield info
                index += 1


def _describe(index: int, platform: cl.Platform, handle: cl.Device) -> DeviceInfo:
    kind: Literal["gpu", "cpu", "accelerator"] = "accelerator"
    if handle.type & cl.device_type.GPU:
        kind = "gpu"
    elif handle.type & cl.device_type.CPU:
        kind = "cpu"
    native = int(handle.native_vector_width_float)
    # A CPU runtime that asks for scalars packs work-items into vectors itself, as GPUs do; see quirks.SHORT_LOOPS too.
    family: Family = "cpu" if kind == "cpu" and native > 1 else "gpu"
    return DeviceInfo(
        index=index,
        name=handle.name.strip(),
        platform=platform.name.strip(),
        version=platform.version.strip(),
        kind=kind,
        integrated=bool(handle.host_unified_memory),
        memory=int(handle.global_mem_size),
        largest_buffer=int(handle.max_mem_alloc_size),
        local_memory=int(handle.local_mem_size),
        compute_units=int(handle.max_compute_units),
        vector_width=max(w for w in (1, 4, 8, 16) if w <= max(native, 1)),
        max_work_group=int(handle.max_work_group_size),
        family=family,
        longest_kernel=limits.longest_kernel(kind, handle),
        profiling=bool(handle.queue_properties & cl.command_queue_properties.PROFILING_ENABLE),
        handle=handle,
    )


def _preference(info: DeviceInfo) -> tuple[float, ...]:
    """Sort key, best first: discrete GPU, integrated GPU, accelerator, CPU runtimes by measured speed."""
    platform = info.platform.lower()
    if quirks.SIMULATOR.concerns(info.platform, info.version):
        return (9, 0, info.index)
    if info.kind == "gpu":
        return (1 if info.integrated else 0, 0, info.index)
    if info.kind == "accelerator":
        return (2, 0, info.index)
    if "intel" in platform:
        return (3, 0, info.index)
    if quirks.is_pocl(info.platform):
        release = re.search(r"pocl (\d+)\.(\d+)", info.version.lower())
        newness = int(release[1]) + int(release[2]) / 100 if release else 0.0
        return (4, -newness, info.index)
    return (5, 0, info.index)


def compiler_fault(info: DeviceInfo) -> str | None:
    """Why a device can compile nothing, not even an empty program; None if it can.

    Only those that :data:`potr_cl.opencl.quirks.UNKNOWN_CPU` concerns are asked, the others are believed. Being asked
    costs a few hundredths of a second, the first time.
    """
    asked = info.kind == "cpu" and quirks.UNKNOWN_CPU.concerns(info.platform, info.version)
    return compiler.fault(info.handle) if asked else None


def _cpu_runtime_advice() -> str:
    """How to get a CPU runtime that works on this machine."""
    pocl = "a newer PoCL from your system's packages (Debian, Ubuntu: pocl-opencl-icd)"
    if sys.platform in ("linux", "win32") and machine().lower() in ("x86_64", "amd64"):
        return f"{install_command('intel-cpu')} (for AMD's CPUs too), or {pocl}"
    return pocl


def fault_of(info: DeviceInfo) -> str | None:
    """Why a device is not to be taken, in a clause; None if it is.

    What crashes encodes has a verdict (:mod:`potr_cl.opencl.verdict`). Of runtimes that
    :data:`potr_cl.opencl.quirks.CRASHES` concerns it is made here, the first time: seconds.
    """
    if (said := compiler_fault(info)) is not None:
        return f"cannot compile even an empty program ({said})"
    known, said = verdict.kept(info)
    if not known and verdict.TRUST_VARIABLE not in os.environ and quirks.CRASHES.concerns(info.platform, info.version):
        logger.info("trying %s in a process of its own, once, since this runtime has crashed elsewhere …", info)
        said = verdict.tried(info)
    return None if said is None else f"failed its self-check, which `devices --check` repeats ({said})"


def not_to_be_taken(infos: Sequence[DeviceInfo], fault: str | None) -> str:
    """One line that says so of these devices, why, and how to mend it."""
    return f"device {', '.join(map(str, infos))} {fault}: mend it by {_cpu_runtime_advice()}"


_passed_over: set[DeviceInfo] = set()


def choose_device(spec: str | None = None) -> DeviceInfo:
    """The best of the devices that ``spec`` fits and that work, as far as is known (see :func:`fault_of`).

    Better ones that do not are passed over with a warning, one a process.

    Args:
        spec: as for :func:`fitting_devices`.

    Raises:
        DeviceError: there is no device, none that ``spec`` fits, or none of those works.
    """
    return _first_able(fitting_devices(spec))


def _first_able(infos: Sequence[DeviceInfo]) -> DeviceInfo:
    """The first of these devices that works.

    Raises:
        DeviceError: none does.
    """
    unable: dict[DeviceInfo, str] = {}
    for info in infos:
        if (fault := fault_of(info)) is None:
            if not _passed_over.issuperset(unable):
                _passed_over.update(unable)
                logger.warning("%s; going on with %s", not_to_be_taken(list(unable), next(iter(unable.values()))), info)
            return info
        unable[info] = fault
    raise DeviceError(not_to_be_taken(list(unable), next(iter(unable.values()))))


def several_are_named() -> bool:
    """Whether the environment names several devices, for those that ask for none."""
    named = os.environ.get(DEVICE_VARIABLE, "")
    return named.strip().lower() == "all" or "," in named


def _by_preference() -> list[DeviceInfo]:
    """All devices, best first.

    Raises:
        DeviceError: there is none.
    """
    devices = sorted(list_devices(), key=_preference)
    if not devices:
        raise DeviceError(
            f"no OpenCL device found: install your GPU's OpenCL driver, or a CPU runtime by {_cpu_runtime_advice()}"
        )
    return devices


def choose_devices(spec: str | None = None) -> list[DeviceInfo]:
    """The devices that a name of several stands for, or the one that :func:`choose_device` takes.

    Args:
        spec: "all", the best device and all others of its kind and platform; indices of :func:`list_devices` with
            commas between them, "0,1"; or what :func:`fitting_devices` takes.

    Raises:
        DeviceError: there is no such device, one is named twice, or one cannot compile.
    """
    spec = spec or os.environ.get(DEVICE_VARIABLE)
    parts = [part.strip() for part in (spec or "").split(",")]
    if spec and spec.strip().lower() == "all":
        every = _by_preference()
        best = _first_able(every)
        alike = [info for info in every if (info.kind, info.platform) == (best.kind, best.platform)]
        return [best, *(info for info in alike if info != best and fault_of(info) is None)]
    if len(parts) > 1 and all(part.isdecimal() and len(part) < 9 for part in parts):
        if len(set(map(int, parts))) < len(parts):
            raise DeviceError(f"'{spec}' names a device twice: name each once")
        return [choose_device(part) for part in parts]
    return [choose_device(spec)]


def fitting_devices(spec: str | None = None) -> list[DeviceInfo]:
    """The devices that ``spec`` fits, best first: discrete GPUs, integrated ones, then CPU runtimes by speed.

    Args:
        spec: an index of :func:`list_devices`, "cpu", "gpu", or part of a device's or platform's name in any case;
            None takes the environment variable ``POTR_CL_DEVICE``; without that every device fits.

    Raises:
        DeviceError: there is no device, or none that ``spec`` fits.
    """
    devices = _by_preference()
    spec = spec or os.environ.get(DEVICE_VARIABLE)
    if not spec:
        return devices
    wanted = spec.strip().lower()
    if wanted == "all" or re.fullmatch(r"\d+(\s*,\s*\d+)+", wanted):
        raise DeviceError(f"'{spec}' names several devices, but only encode and compare share their work out: name one")
    if wanted.isdecimal() and len(wanted) < 9:
        matches = [d for d in devices if d.index == int(wanted)]
    elif wanted in ("cpu", "gpu"):
        matches = [d for d in devices if d.kind == wanted]
    else:
        matches = [d for d in devices if wanted in d.name.lower() or wanted in d.platform.lower()]
    if not matches:
        listed = ", ".join(f"{d.index}: {d.name}" for d in sorted(devices, key=lambda d: d.index))
        raise DeviceError(f"no OpenCL device fits '{spec}': give an index or a part of a name of {listed}")
    return matches
