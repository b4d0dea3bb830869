"""Write a file whole or not at all: into a temporary neighbour first, renamed over the target at the end."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from potr_cl.errors import UnwritableError, UsageError, WriteError
from potr_cl.host.leftovers import removed_at_end

#: Seconds to wait before a renaming is tried again: on Windows nobody renames a file that another program has open, as
#: virus scanners and indexers have new ones for a moment.
_PAUSES = (0.05, 0.2, 0.5, 1.0, 3.0) if os.name == "nt" else ()


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file beside ``path`` for writing; rename it to ``path`` when the block ends well.

    If the block fails in any way (Ctrl-C included), the temporary file is removed and an existing file at ``path``
    keeps its content. A symbolic link is followed: what it points to is replaced, not the link. An existing file
    keeps its permission bits, a new one gets those that the umask leaves.

    Args:
        path: of the file to write.

    Yields:
        The open binary file: seekable, positioned at 0.

    Raises:
        UsageError: ``path`` is a directory or another thing that is no regular file, its folder does not exist
            or cannot be written to.
        WriteError: the system failed to write (disk full, quota, I/O error), or has no such folder any more.
    """
    target = Path(os.path.realpath(path))
    mode = _mode_of_existing(target, path)
    # Not derived from the whole name, which may already be as long as the file system allows.
    temporary = target.with_name(f".{target.name[:40]}.{secrets.token_hex(6)}.tmp")
    with removed_at_end(temporary):  # after the renaming there is nothing left to remove
        try:
            descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except OSError as error:
            why = error.strerror if target.parent.is_dir() else _no_folder(target.parent)
            raise UnwritableError(f"cannot write '{path}': {why}", os.fspath(path)) from error
        try:
            # Closing flushes: a full disk may show only then, so it has to happen before the renaming.
            with os.fdopen(descriptor, "w+b") as file:
                yield file
            if mode is not None:
                temporary.chmod(mode)
            _rename(temporary, target)
        except OSError as error:
            if error.filename not in (None, os.fspath(temporary)):
                raise  # about another file, which the block has to do with
            why = error.strerror or str(error)
            if not target.parent.is_dir():
                why = f"the folder '{target.parent}' is gone"
            raise WriteError(f"cannot write '{path}': {why}", os.fspath(path)) from error


def _rename(temporary: Path, target: Path) -> None:
    for pause in _PAUSES:
        with contextlib.suppress(PermissionError):
            temporary.replace(target)
            return
        time.sleep(pause)
    temporary.replace(target)


def write_pieces(path: str | os.PathLike[str], pieces: Iterable[bytes | memoryview]) -> None:
    """Write a file from pieces, one after another; it appears when it is whole. Raises as :func:`replacing`."""
    with replacing(path) as file:
        for piece in pieces:
            file.write(piece)


def write_files(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files of a folder, by names that may have folders of their own: none appears before all are whole.

    Raises:
        WriteError: the system failed to write, or cannot make a folder.
    """
    temporary = folder / f".{secrets.token_hex(6)}.tmp"
    with removed_at_end(temporary):
        try:
            for name, content in contents.items():
                (temporary / name).parent.mkdir(parents=True, exist_ok=True)
                (temporary / name).write_bytes(content)
            for name in contents:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                _rename(temporary / name, folder / name)
        except OSError as error:
            why = error.strerror or str(error)
            raise WriteError(f"cannot write to the folder '{folder}': {why}", os.fspath(folder)) from error


def check_place(path: str | os.PathLike[str]) -> None:
    """Refuse a path that no file can be written to, before work for hours begins; nothing is made for the trial.

    Raises:
        UsageError: ``path`` is a directory or another thing that is no regular file, or no file can be made in its
            folder.
    """
    target = Path(os.path.realpath(path))
    _mode_of_existing(target, path)
    if not target.parent.is_dir():
        raise UnwritableError(f"cannot write '{path}': {_no_folder(target.parent)}", os.fspath(path))
    if not os.access(target.parent, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids):
        read_only = hasattr(os, "statvfs") and os.statvfs(target.parent).f_flag & os.ST_RDONLY
        why = os.strerror(errno.EROFS if read_only else errno.EACCES)
        raise UnwritableError(f"cannot write '{path}': {why}", os.fspath(path))


def _no_folder(folder: Path) -> str:
    """Why no file can be in what is no folder."""
    if os.path.lexists(folder):
        return f"'{folder}' is not a folder"
    home = "; '~' is not expanded here: write the home folder out" if "~" in folder.parts else ""
    return f"the folder '{folder}' does not exist{home}"


def _mode_of_existing(target: Path, path: str | os.PathLike[str]) -> int | None:
    """Permission bits of the regular file that is to be replaced; None if there is none."""
    try:
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None  # a new file; if its folder is missing, opening the temporary file tells
    except OSError as error:
        raise UnwritableError(f"cannot write '{path}': {error.strerror}", os.fspath(path)) from error
    if stat.S_ISDIR(mode):
        raise UnwritableError(f"cannot write '{path}': it is a directory; give the name of a file", os.fspath(path))
    if not stat.S_ISREG(mode):
        raise UnwritableError(f"cannot write '{path}': it is not a regular file", os.fspath(path))
    return stat.S_IMODE(mode)


def make_folder(folder: Path) -> None:
    """Make a folder unless it is there.

    Raises:
        UsageError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{folder}': {error.strerror}") from None
