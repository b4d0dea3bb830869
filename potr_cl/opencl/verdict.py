"""Whether a device survives what encodes run on it: tried in another process (:func:`tried`), and kept (:func:`kept`).

A driver that crashes takes its process with it, so that nobody could say what happened. The trial
(:mod:`potr_cl.pipeline.trial`) takes seconds, and what it builds is cached for whoever goes on. It is made by ``devices
--check``, and once, before the first work, for runtimes that have crashed (:data:`potr_cl.opencl.quirks.CRASHES`):
others would lose seconds for nothing. Its verdict holds for one device, driver and state of the kernels, and can be had
anew by ``devices --check``.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

if TYPE_CHECKING:
    from potr_cl.opencl.discovery import DeviceInfo

_PASSED = "passed"
#: A trial that takes longer has failed: seconds. With empty caches it takes half a minute, on a busy machine minutes.
_PATIENCE = 1200.0
#: Environment variable that has every device taken untried and whatever its verdict, as in the trial's own process.
TRUST_VARIABLE = "POTR_CL_TRUST_DEVICES"
#: What a program of Windows ends with that Ctrl-C ends.
_WINDOWS_CTRL_C = 0xC000013A
_MODULE = "potr_cl.pipeline.trial"


def kept(info: DeviceInfo) -> tuple[bool, str | None]:
    """Whether a device was tried, and if so, what is wrong with it; None if nothing is."""
    if TRUST_VARIABLE in os.environ:
        return False, None
    try:
        said = _file(info).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False, None
    return True, None if said == _PASSED else said


def tried(info: DeviceInfo) -> str | None:
    """Try a device, and keep the verdict where the user's cache can be written: what is wrong, None if nothing is."""
    return _settled(info, *_trial(info)[:2])


def measured(info: DeviceInfo) -> tuple[str | None, dict[str, Any]]:
    """The same, and what :func:`potr_cl.pipeline.trial.measured` finds; nothing of a device that fails."""
    decided, fault, said = _trial(info, "--measure")
    with suppress(ValueError):
        return _settled(info, decided, fault), json.loads(said)
    return _settled(info, decided, fault), {}


def _settled(info: DeviceInfo, decided: bool, fault: str | None) -> str | None:
    path = _file(info)
    with suppress(OSError):
        if not decided:
            return None
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(fault or _PASSED, encoding="utf-8")
    return fault


def _trial(info: DeviceInfo, *how: str) -> tuple[bool, str | None, str]:
    """Whether a trial came to an end, what is wrong, and what it printed."""
    command = [sys.executable, "-m", _MODULE, str(info.index), *how]
    folders = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {TRUST_VARIABLE: "1", "PYTHONPATH": folders}
    try:
        run = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return True, f"its self-check did not end within {_PATIENCE / 60:.0f} minutes", ""
    except OSError:
        return False, None, ""  # where no process can be started
    if run.returncode in (
        0,
        -signal.SIGINT,
        -signal.SIGTERM,
        -9,
        _WINDOWS_CTRL_C,
    ):  # -9: killed, perhaps as memory was short
        return run.returncode == 0, None, run.stdout.decode("utf-8", "replace")
    if run.returncode < 0 or run.returncode >= 1 << 30:  # a signal, or an exception of Windows
        return True, "its driver crashes while an encode runs", ""
    lines = run.stderr.decode("utf-8", "replace").strip().splitlines()
    return True, lines[-1] if lines else f"its self-check ended with exit code {run.returncode}", ""


def _file(info: DeviceInfo) -> Path:
    driver = getattr(info.handle, "driver_version", "")
    about = (info.name, info.platform, info.version, driver, info.family, _kernels())
    digest = hashlib.sha256(repr(about).encode()).hexdigest()[:16]
    return Path(platformdirs.user_cache_dir("potr_cl", "potr_cl")) / "verdicts" / digest


@functools.cache
def _kernels() -> tuple[tuple[str, int], ...]:
    """Names and sizes of the kernels' files: what a verdict is about."""
    folder = Path(__file__).parents[1] / "cl"
    return tuple(sorted((str(path.relative_to(folder)), path.stat().st_size) for path in folder.rglob("*.cl*")))
