"""A file that is read must not change meanwhile (:func:`unchanged`): a part of it would be older than another."""

from __future__ import annotations

import contextlib
import os
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
