"""The OpenCL devices there are and what matters about them, as numbers and as a table."""

from __future__ import annotations

import getpass
import os
import platform
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from potr_cl import __version__
from potr_cl.opencl import quirks, verdict
from potr_cl.opencl.discovery import DeviceInfo, compiler_fault, fitting_devices, list_devices
from potr_cl.opencl.limits import LIMITS_VARIABLE

#: Paths of files, as compilers' messages have them.
_PATH = re.compile(r"(?:\b[A-Za-z]:)?(?:[\\/][^\s\\/:'\"<>|,;()]+){2,}[\\/]?")


def measured_report() -> dict[str, Any]:
    """What is worth posting of this machine: its devices checked and measured, without names and paths of the user.

    Simulators are left out: they would take hours.
    """
    measured = {info.index: verdict.measured(info) for info in list_devices() if _is_measured(info)}
    report = device_report(False)
    for entry, info in zip(report, list_devices(), strict=True):
        driver, language = (getattr(info.handle, name, "") for name in ("driver_version", "opencl_c_version"))
        entry |= {"driver": driver, "opencl_c": language, "extensions": getattr(info.handle, "extensions", "").split()}
        entry |= {"longest_kernel": info.longest_kernel, "profiling": info.profiling}
        if info.index in measured:
            fault, found = measured[info.index]
            entry |= {"check": fault or "passed", **found}
    about = {"potr_cl": __version__, "pyopencl": version("pyopencl"), "python": platform.python_version()}
    more = {"system": platform.system(), "machine": platform.machine(), "limits": os.environ.get(LIMITS_VARIABLE)}
    named: dict[str, Any] = _without_names(about | more | {"devices": report})
    return named


def _is_measured(info: DeviceInfo) -> bool:
    return compiler_fault(info) is None and not quirks.SIMULATOR.concerns(info.platform, info.version)


def _without_names(value: Any) -> Any:
    """A document whose texts have no path, nor the names of the user and of the computer."""
    if isinstance(value, dict):
        return {name: _without_names(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_without_names(each) for each in value]
    if not isinstance(value, str):
        return value
    names = {platform.node(), Path.home().name, Path(sys.prefix).name}
    with suppress(OSError, KeyError, ImportError):
        names.add(getpass.getuser())
    for name in filter(None, names):
        value = re.sub(rf"\b{re.escape(name)}\b", "…", value)
    return _PATH.sub("…", value)


def device_report(check: bool) -> list[dict[str, Any]]:
    """One entry a device, in the order of their indices; "fault" says why a device can compile nothing, or is None.

    Args:
        check: run each device's self-check anew, in a process of its own; the entry's "check" is then "passed" or says
            what failed. Without it "check" stands only where that was done before.

    Raises:
        DeviceError: there is no device at all, or the environment variable names one that there is not.
    """
    checks = {info.index: _checked(info, check) for info in list_devices()}
    able = (i.index for i in fitting_devices() if compiler_fault(i) is None and checks[i.index] in (None, "passed"))
    chosen = next(able, None)
    return [_entry(info, info.index == chosen, checks[info.index]) for info in list_devices()]


def _checked(info: DeviceInfo, anew: bool) -> str | None:
    if compiler_fault(info) is not None:
        return None
    known, said = (True, verdict.tried(info)) if anew else verdict.kept(info)
    return (said or "passed") if known else None


def _entry(info: DeviceInfo, chosen: bool, check: str | None) -> dict[str, Any]:
    entry = {
        "index": info.index,
        "chosen": chosen,
        "name": info.name,
        "platform": info.platform,
        "version": info.version,
        "kind": info.kind,
        "integrated": info.integrated,
        "memory_bytes": info.memory,
        "largest_buffer_bytes": info.largest_buffer,
        "local_memory_bytes": info.local_memory,
        "compute_units": info.compute_units,
        "vector_width": info.vector_width,
        "kernels": info.family,
        "fault": compiler_fault(info),
    }
    return entry if check is None else entry | {"check": check}


def format_devices(report: Sequence[dict[str, Any]]) -> str:
    """The report as lines for people.

    ``*`` marks the device that is taken without ``--device``, ``!`` those that do not work, as far as was looked.
    """
    lines = [
        f"{'':<2}{'index':<7}{'kind':<6}{'kernels':<9}{'memory':>9}{'buffer':>9}{'local':>8}{'units':>7}{'vector':>8}"
        "  name (platform)"
    ]
    for entry in report:
        lines.append(
            f"{_mark(entry):<2}{entry['index']:<7}{entry['kind']:<6}{entry['kernels']:<9}"
            f"{entry['memory_bytes'] / 1e9:>6.1f} GB{entry['largest_buffer_bytes'] / 1e9:>6.1f} GB"
            f"{entry['local_memory_bytes'] / 1024:>5.0f} KB{entry['compute_units']:>7}{entry['vector_width']:>8}"
            f"  {entry['name']} ({entry['platform']})"
        )
        if entry["fault"] is not None:
            lines.append(f"  cannot compile anything: {entry['fault']}")
        elif "check" in entry:
            lines.append(f"  self-check: {entry['check']}")
    return "\n".join(lines)


def works(entry: dict[str, Any]) -> bool:
    """Whether a device can compile and, where it was checked, passed."""
    return entry["fault"] is None and entry.get("check", "passed") == "passed"


def _mark(entry: dict[str, Any]) -> str:
    return ("*" if entry["chosen"] else "") + ("" if works(entry) else "!")
