"""Scenes that come through a pipe (:func:`received`) or go into one (:func:`send`), in any format that files have."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from potr_cl.errors import DataError, PotrError
from potr_cl.formats import registry
from potr_cl.host.leftovers import temporary_folder

#: What a stream is called in messages.
STANDARD_INPUT = "standard input"
#: Some 70 million splats of SH degree 3 as a PLY. A file has an end, a stream need not have one.
MOST_BYTES = 1 << 34
_PART = 1 << 20


@contextlib.contextmanager
def received(stream: BinaryIO, suffix: str | None = None, name: str = STANDARD_INPUT) -> Iterator[Path]:
    """What a stream brings, as a temporary file, which every reader of files takes with the checks that it has.

    Nothing but the first bytes is read of a stream that brings no scene. What is raised over the file in the block, and
    what is logged, speaks of ``name`` instead of the file.

    Args:
        stream: is read to its end.
        suffix: of the format, ".ply"; by default the content tells it.
        name: of the stream, for messages.

    Yields:
        The file's path; it is gone after the block.

    Raises:
        UsageError: no format has the suffix, or there is no place for temporary files.
        DataError: the stream is empty, brings nothing that is known, or more than any scene has.
    """
    start = _read(stream, registry.START_BYTES)
    if not start:
        raise DataError(f"the {name} is empty: nothing was piped into it")
    suffix = registry.suffix_of_content(start, name) if suffix is None else registry.read_suffix(suffix)
    with temporary_folder() as folder:
        path = Path(folder, f"scene{suffix}")
        _store(stream, start, path, name)
        with _called(path, name):
            yield path


def send(stream: BinaryIO, suffix: str, save: Callable[[Path], None]) -> int:
    """Write what goes into a file into a stream, all of it or nothing.

    Args:
        stream: takes the bytes.
        suffix: of the file that is written meanwhile.
        save: writes a file under the path that it is given.

    Returns:
        The number of bytes.
    """
    with temporary_folder() as folder:
        path = Path(folder, f"scene{suffix}")
        with _called(path, "standard output"):
            save(path)
        with path.open("rb") as file:
            shutil.copyfileobj(file, stream, _PART)
        stream.flush()
        return path.stat().st_size


def _read(stream: BinaryIO, wanted: int) -> bytes:
    """So many bytes, or all there are: a pipe gives what it has."""
    parts = bytearray()
    while len(parts) < wanted and (part := stream.read(wanted - len(parts))):
        parts += part
    return bytes(parts)


def _store(stream: BinaryIO, start: bytes, path: Path, name: str) -> None:
    size, part = 0, start
    try:
        with path.open("xb") as file:
            while part:
                size += len(part)
                if size > MOST_BYTES:
                    raise DataError(f"the {name} brings more than {MOST_BYTES} bytes: save it to a file and name that")
                file.write(part)
                part = stream.read(_PART)
    except OSError as error:
        raise PotrError(
            f"cannot keep what the {name} brings in '{path.parent}': {error.strerror or error}: make room there, or "
            "name another folder by the environment variable TMPDIR"
        ) from error


@contextlib.contextmanager
def _called(path: Path, name: str) -> Iterator[None]:
    """Of a block in which a file is called by another name in errors of ours and in the log "potr_cl"."""
    quoted, known = f"'{os.fspath(path)}'", f"the {name}"

    class Renamed(logging.Filter):
        def filter(self, record: logging.LogRecord) -> bool:
            record.msg, record.args = record.getMessage().replace(quoted, known), None
            return True

    log, renamed = logging.getLogger("potr_cl"), Renamed()
    log.addFilter(renamed)
    try:
        yield
    except PotrError as error:
        if quoted not in str(error):
            raise
        raise type(error)(str(error).replace(quoted, known)) from error
    finally:
        log.removeFilter(renamed)
