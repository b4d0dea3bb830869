"""Files of Git LFS that were never fetched: what is there is a few lines that point to them."""

from __future__ import annotations

import os

from potr_cl.errors import DataError

_START = b"version https://git-lfs.github.com/spec/"


def is_lfs_pointer(start: bytes) -> bool:
    """Whether a file that begins like this is a pointer of Git LFS."""
    return start.startswith(_START)


def refuse_lfs_pointer(path: str | os.PathLike[str]) -> None:
    """Say what is to be done where a file is a pointer. A file that cannot be read is left to whoever reads it.

    Raises:
        DataError: it is one.
    """
    try:
        if not os.path.isfile(path):
            return
        with open(path, "rb") as file:
            start = file.read(len(_START))
    except (OSError, ValueError):
        return
    if is_lfs_pointer(start):
        raise DataError(f"'{path}' is a Git-LFS pointer, not the file itself: run 'git lfs pull' where it came from")
