"""Where pyopencl keeps built programs on the disk (:func:`folder`), such that nothing there can stop a build.

pyopencl's cache has a lock, a file that a killed process leaves behind: every process after it would wait for a minute
and then fail. And where its caches cannot be written, as in a container without a home, it ends with an exception.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from contextlib import suppress

import platformdirs
import pyopencl as cl

# pyopencl asks for it without a default, when it cannot write a program.
os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")

#: Processes hold the lock while they read or write a program, which takes milliseconds. Seconds after which one that
#: is still the same is nobody's; and the age at which nobody needs to wait for that.
PATIENCE, OLD = 5.0, 60.0


def folder(program: str = "") -> str | bool:
    """The folder to give to pyopencl, without a lock that was left; False, for none, where it cannot be written.

    Args:
        program: what names one program: it has a folder of its own, so that nobody waits for who loads or builds
            another one. None is named: the folder of all these.
    """
    version = ".".join(map(str, sys.version_info[:2]))
    name = os.path.join(platformdirs.user_cache_dir("potr_cl", "potr_cl"), f"programs-py{version}")
    if program:
        name = os.path.join(name, hashlib.sha256(program.encode()).hexdigest()[:16])
    if not _can_be_written(name):
        return False
    _remove_left_lock(os.path.join(name, "lock"))
    return name


def _can_be_written(name: str) -> bool:
    """Whether a folder can; it is made where it is missing."""
    try:
        os.makedirs(name, exist_ok=True)
    except OSError:
        return False
    return os.access(name, os.W_OK | os.X_OK)


if not _can_be_written(platformdirs.user_cache_dir("pytools", "pytools")):
    # The code that calls a kernel is kept there. The environment variable for this is read before anyone can set it.
    cl._PYOPENCL_NO_CACHE = True


def _remove_left_lock(lock: str) -> None:
    first = _identity(lock)
    if first is None:
        return
    end = time.monotonic() + (0 if time.time() - first[1] > OLD else PATIENCE)
    while time.monotonic() < end:
        time.sleep(0.05)
        if _identity(lock) != first:
            return  # it is in use, by one process after another
    with suppress(OSError):
        os.unlink(lock)


def _identity(lock: str) -> tuple[int, float] | None:
    """Which lock it is and of when; None if there is none."""
    try:
        status = os.stat(lock)
    except OSError:
        return None
    return status.st_ino, status.st_mtime
