"""Checks of any file that is read: that nobody writes to it meanwhile (:func:`unchanged`), that it is no pointer of Git
LFS (:func:`refuse_lfs_pointer`), and that it holds no more than its size lets believe (:func:`check_claim`).
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Iterator
from io import IOBase
from typing import TypeAlias

from potr_cl.errors import DataError

#: What tells one state of a file from another: which file it is, its size, and when it was written.
State: TypeAlias = "tuple[int, int, int, int]"


@contextlib.contextmanager
def unchanged(path: str | os.PathLike[str], file: IOBase) -> Iterator[None]:
    """Of a block that reads a file: nobody may write to it meanwhile.

    Args:
        path: of the file, for the message.
        file: open, at the beginning of the block.

    Raises:
        DataError: the file has another size or time of change than at the beginning, whatever else went wrong.
    """
    descriptor = os.dup(file.fileno())  # whoever reads may close the file
    try:
        before = state_of(descriptor)
        try:
            yield
        except DataError as error:
            refuse_changed(path, before, state_of(descriptor), error)
            raise
        refuse_changed(path, before, state_of(descriptor))
    finally:
        os.close(descriptor)


def is_device_of_windows(name: str) -> bool:
    """Whether a file's name stands for a device on Windows, in any folder and whatever suffix it has."""
    return re.fullmatch(r"(con|prn|aux|nul|(com|lpt)[0-9¹²³]) *(\..*)?", name, re.IGNORECASE) is not None


def state_of(descriptor: int) -> State:
    """The state of an open file; always the same of a pipe, which is read once."""
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        return status.st_dev, status.st_ino, 0, 0
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def refuse_changed(path: str | os.PathLike[str], before: State, after: State, error: Exception | None = None) -> None:
    """Raise if two states of a file differ.

    Args:
        path: of the file, for the message.
        before, after: the states.
        error: what went wrong because of it, if anything did.

    Raises:
        DataError: they do.
    """
    if after != before:
        raise DataError(
            f"'{path}' was changed while it was read: wait until the program that writes it has finished"
        ) from error


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


#: Any file may hold so many: the memory that they take is nothing to worry about.
FREE_SPLATS = 1 << 16


def check_claim(number: int, file_bytes: int, most_a_byte: int, trust: bool, what: str = "splats") -> None:
    """Refuse a number that no real scene would pack into so small a file.

    Args:
        number: that the file claims.
        file_bytes: size of the file.
        most_a_byte: the largest believable number in a byte of the format.
        trust: whether the user vouches for the file, so that nothing is refused.
        what: is counted, for the message.

    Raises:
        DataError: the claim is beyond belief.
    """
    if not trust and number > FREE_SPLATS + most_a_byte * file_bytes:
        raise DataError(
            f"{number} {what} in {file_bytes} bytes are more than a real scene packs into them, and could fill the "
            "memory: if you know where the file comes from, read it with --trust (in Python: trust=True)"
        )
