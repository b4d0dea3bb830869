"""Arrays that lie in a temporary file and not in memory (:func:`mapped`).

The system keeps as many of their pages in memory as it has room for, and writes the others to the file. The file has
no name: nothing is left of it, whatever ends the process.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
from typing import Any

import numpy as np

from potr_cl.errors import PotrError
from potr_cl.host.leftovers import place_for_temporary_files

#: What a file system says that cannot promise room.
_NO_PROMISE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


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
