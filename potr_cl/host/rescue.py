"""What took long to make is not lost where it cannot be written: :func:`written_or_kept`, :func:`replacing_or_keeping`.

A disk may become full while somebody computes for hours, a network drive go away, a folder be removed. The result is
kept in another place then, and the error says where.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from potr_cl.errors import PotrError, WriteError
from potr_cl.host.atomic_write import replacing
from potr_cl.host.leftovers import place_for_temporary_files, removed_at_end


def written_or_kept(path: str | os.PathLike[str], write: Callable[[Path], object]) -> None:
    """Write a file, or several beside each other; if the system fails to, write them elsewhere and say where.

    The places are the system's folder for temporary files and the user's home folder, each tried in turn, in a new
    folder of this user alone.

    Args:
        path: where it is wanted.
        write: writes under the path that it is given; called again with others.

    Raises:
        WriteError: it is not at ``path``; the message says where it is.
        PotrError: whatever else ``write`` raises.
    """
    try:
        write(Path(path))
    except WriteError as error:
        raise kept_elsewhere(error, path, write) from error


@contextlib.contextmanager
def replacing_or_keeping(path: str | os.PathLike[str]) -> Iterator[Outcome]:
    """As :func:`potr_cl.host.atomic_write.replacing`, for content that is handed over whole, once it is made.

    Raises:
        UsageError: as :func:`potr_cl.host.atomic_write.replacing`, before anything is made.
        WriteError: it is not at ``path``; the message says where it is.
    """
    outcome = Outcome()
    try:
        with replacing(path) as outcome.file:
            yield outcome
    except WriteError as error:
        content = outcome.content
        # The error may also be that of another file, which somebody writes in the block.
        if content is None or error.path != os.fspath(path):
            raise
        raise kept_elsewhere(error, path, lambda where: where.write_bytes(content)) from error


class Outcome:
    """A file that is to be made of what is handed over.

    Attributes:
        content: of the whole file, once it has been handed over.
    """

    file: BinaryIO

    def __init__(self) -> None:
        self.content: bytes | None = None

    def write(self, content: bytes) -> None:
        """Hand the whole file over."""
        self.content = content
        self.file.write(content)


def kept_elsewhere(error: PotrError, path: str | os.PathLike[str], write: Callable[[Path], object]) -> WriteError:
    """Write what could not be written to a path to another place.

    Args:
        error: that kept it from ``path``.
        path: whose name it gets there.
        write: as of :func:`written_or_kept`.

    Returns:
        What to raise: the error, and where the file is now.
    """
    places = list(_places())
    for place in places:
        folder = place / f"potr-cl-kept-{secrets.token_hex(6)}"
        unfinished = folder.with_name(f".{folder.name}.tmp")
        with contextlib.suppress(OSError, PotrError), removed_at_end(unfinished):
            unfinished.mkdir(mode=0o700)
            write(unfinished / Path(path).name)
            unfinished.rename(folder)
            return _told(error, f"the result is kept as '{folder / Path(path).name}': move it from there")
    tried = " or ".join(f"'{place}'" for place in places)
    return _told(error, "the result is lost: there is no room for it" + (f" in {tried} either" if tried else ""))


def _told(error: PotrError, more: str) -> WriteError:
    told = WriteError(f"{error}; {more}", getattr(error, "path", ""))
    told.exit_code = error.exit_code
    return told


def _places() -> Iterator[Path]:
    with contextlib.suppress(OSError):
        yield Path(place_for_temporary_files())
    with contextlib.suppress(RuntimeError, OSError):  # nobody's process may have no home
        yield Path.home()
