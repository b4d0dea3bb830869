"""The devices and kernel families that the kernels are tested on."""

from __future__ import annotations

import functools
import importlib.metadata
from typing import Any, cast

import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, Family, choose_device, compiler_fault, list_devices
from potr_cl.opencl.verdict import kept, tried


def _is_of_pip(info: DeviceInfo) -> bool:
    try:
        return f"pocl {importlib.metadata.version('pocl-binary-distribution')}" in info.version.lower()
    except importlib.metadata.PackageNotFoundError:
        return False


def _pocl() -> DeviceInfo | None:
    """PoCL where another device goes before it: pip's, or if that does not know this CPU, any other that does."""
    found = [info for info in list_devices() if info.kind == "cpu" and "portable computing" in info.platform.lower()]
    able = sorted((info for info in found if compiler_fault(info) is None), key=lambda info: not _is_of_pip(info))
    try:
        return able[0] if able and able[0] != choose_device() else None
    except DeviceError:
        return None


_POCL = _pocl()

#: Parameters of fixtures, for :func:`open_device`: both families on the device that is taken by default, and again on
#: PoCL, which every installation on Linux brings. tests/opencl/test_discovery.py skips what cannot compile, visibly.
KERNELS: list[Any] = ["cpu", "gpu"]
#: Parameters for tests of what the host does, which does not depend on the runtime.
FAMILIES: list[Any] = ["cpu", "gpu"]
if _POCL is not None:
    KERNELS += [pytest.param(f"{family}-pocl", marks=pytest.mark.slow) for family in ("cpu", "gpu")]


@functools.cache
def _fault(info: DeviceInfo) -> str | None:
    """What is wrong with a device, tried in another process: some versions of PoCL crash on some CPUs."""
    decided, fault = kept(info)
    return fault if decided else tried(info)


def skip_without_cpu() -> None:
    """Skip the test where there is only a GPU."""
    try:
        choose_device("cpu")
    except DeviceError:
        pytest.skip("no CPU among the OpenCL devices")


def open_device(kernels: str) -> Device:
    """The device of one of :data:`KERNELS`; skips the test if it cannot run that family."""
    family, _, runtime = kernels.partition("-")
    info = _POCL if runtime and _POCL is not None else choose_device()
    if runtime and (fault := _fault(info)) is not None:
        pytest.skip(f"{info} cannot be tested here: {fault}")
    if family == "cpu" and info.family == "gpu" and info.kind == "cpu":
        pytest.skip(f"{info} does not run the row kernels: it ends long loops early")
    return Device(info, family=cast(Family, family))


@functools.cache
def shared_device(kernels: str, number: int = 0) -> Device:
    """The same as :func:`open_device`, but one for all tests of a process that ask for this number.

    So its programs are built once; who takes memory there gives it back.
    """
    return open_device(kernels)


def another_like(device: Device, number: int) -> Device:
    """One more of the same runtime and family: others round differently."""
    return shared_device(f"{device.family}{'-pocl' if device.info == _POCL else ''}", number)
