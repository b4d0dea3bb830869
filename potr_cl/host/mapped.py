"""Arrays that lie in a temporary file and not in memory (:func:`mapped`), where memory is bounded (:func:`bounded`).

The system keeps as many of their pages in memory as it has room for, and writes the others to the file. The file has
no name: nothing is left of it, whatever ends the process.
"""

from __future__ import annotations

import errno
import logging
import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import PotrError
from potr_cl.host.leftovers import place_for_temporary_files

_log = logging.getLogger("potr_cl")

#: What a file system says that cannot promise room.
_NO_PROMISE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


#: Bytes of the largest array that is not mapped where memory is bounded.
_LARGEST: ContextVar[float] = ContextVar("largest", default=math.inf)
#: What has found no room on the disk in the innermost block; of the first the log is told.
_TOLD: ContextVar[list[str]] = ContextVar("told")
#: It is this part of the memory: of arrays just below it there may be twenty at a time, as of the re-fit's vectors.
_PART = 1 / 64
#: So many times as much memory must be left as an array takes that was to lie in a file.
_PLENTY = 3
#: Rows that are copied at a time.
_ROWS = 1 << 18


@contextmanager
def bounded(memory: float | None) -> Iterator[None]:
    """Have :func:`array` and :func:`rows` map large arrays inside the block.

    Args:
        memory: bytes that the work may take about; None: as before.
    """
    token = _LARGEST.set(_LARGEST.get() if memory is None else _PART * memory)
    told = _TOLD.set([])
    try:
        yield
    finally:
        _LARGEST.reset(token)
        _TOLD.reset(told)


def array(shape: tuple[int, ...], dtype: Any, what: str, first: bool = False) -> np.ndarray[Any, Any]:
    """A new array, not set: as :func:`numpy.empty`, or, if it is large and memory is bounded, as :func:`mapped`.

    Where the disk has no room for a later one, hours of work may be lost. So it is kept in memory then, if there is
    plenty; the logger "potr_cl" is told.

    Args:
        shape, dtype, what: as of :func:`mapped`.
        first: whether it is what the work begins with: nothing is lost yet.

    Raises:
        As :func:`mapped`.
    """
    nbytes = math.prod(shape) * np.dtype(dtype).itemsize
    if nbytes <= _LARGEST.get():
        return np.empty(shape, dtype)
    try:
        return mapped(shape, dtype, what)
    except PotrError as error:
        if first or memory_left() < _PLENTY * nbytes:
            raise
        told = _TOLD.get([])
        if not told:
            _log.warning("%s; it and what follows takes memory beyond --memory now", error)
        told.append(what)
        return np.empty(shape, dtype)


def rows(values: np.ndarray[Any, Any], numbers: np.ndarray[Any, Any] | None, what: str) -> np.ndarray[Any, Any] | None:
    """Some rows of an array, if they are so large that they are mapped; else None: NumPy copies them faster.

    Args:
        values: (N, …).
        numbers: (n,) of the rows, or (N,) bool; None: all.
        what: they are, for the error's sake.

    Raises:
        As :func:`mapped`.
    """
    if values.nbytes <= _LARGEST.get():
        return None
    if numbers is not None and numbers.dtype == bool:
        numbers = np.flatnonzero(numbers)
    count = len(values) if numbers is None else len(numbers)
    found = array((count, *values.shape[1:]), values.dtype, what)
    for first in range(0, count, _ROWS):
        some = slice(first, first + _ROWS)
        found[some] = values[some if numbers is None else numbers[some]]
    return found


def mapped(shape: tuple[int, ...], dtype: Any, what: str) -> np.ndarray[Any, Any]:
    """A new array of zeros in a temporary file, in the system's folder for such (``TMPDIR``).

    All of its room on the disk is taken at once: a page that finds none later would end the process.

    Args:
        shape, dtype: of the array.
        what: it holds, for the error's sake.

    Raises:
        PotrError: the folder has no room for it, or there is none.
    """
    nbytes = math.prod(shape) * np.dtype(dtype).itemsize
    if not nbytes:
        return np.zeros(shape, dtype)
    folder = "there"
    try:
        folder = place_for_temporary_files()
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            _take_room(file.fileno(), nbytes)
            pages = mmap.mmap(file.fileno(), nbytes)
    except (OSError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise PotrError(
            f"no room for {nbytes / 1e9:.1f} GB of {what} in the folder '{folder}' for temporary files ({reason}): "
            "make room there, or name another by the environment variable TMPDIR"
        ) from error
    return np.frombuffer(pages, dtype).reshape(shape)


def _take_room(descriptor: int, nbytes: int) -> None:
    os.ftruncate(descriptor, nbytes)
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(descriptor, 0, nbytes)
    except OSError as error:
        if error.errno not in _NO_PROMISE:
            raise


_SYSTEM = Path("/proc/meminfo")
#: Of a container: what it may take and what it has taken, by version 2 and version 1 of Linux' control groups.
_GROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)


def memory_left() -> int:
    """Bytes of memory that are free, or that the system would free at once; 0 where it does not say (not Linux)."""
    left: int | None = None
    with suppress(OSError, ValueError, IndexError):
        for line in _SYSTEM.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                left = int(line.split()[1]) << 10
    if left is None:
        return 0
    for most, taken in _GROUPS:
        with suppress(OSError, ValueError):  # "max" is no number: there is no limit
            left = min(left, int(most.read_text()) - int(taken.read_text()))
    return max(left, 0)
