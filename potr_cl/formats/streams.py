"""Scenes that are no plain files: gzipped ones (:func:`plain`), and those that come through a pipe (:func:`received`)
or go into one (:func:`send`). Each is a temporary file meanwhile, which every reader or writer takes with the checks
that it has, and of which users are told by the name that they know (:func:`called`).
"""

from __future__ import annotations

import contextlib
import gzip
import logging
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from potr_cl.errors import DataError, PotrError
from potr_cl.formats import registry
from potr_cl.formats.scenes.scene_files import opened
from potr_cl.host.inputs import refuse_lfs_pointer
from potr_cl.host.leftovers import temporary_folder


@contextlib.contextmanager
def called(written: str, known: str) -> Iterator[None]:
    """Of a block in which something is called by another name in errors of ours and in the log "potr_cl".

    Blocks may stand in each other: what the inner one says is told as the outer one calls it.

    Args:
        written: as readers and writers call it.
        known: as users know it.
    """

    class Renamed(logging.Filter):
        def filter(self, record: logging.LogRecord) -> bool:
            record.msg, record.args = record.getMessage().replace(written, known), None
            return True

    log, renamed = logging.getLogger("potr_cl"), Renamed()
    log.filters.insert(0, renamed)  # before the outer blocks' filters, which rename what comes out of this one
    try:
        yield
    except PotrError as error:
        if written not in str(error):
            raise
        raise type(error)(str(error).replace(written, known)) from error
    finally:
        log.removeFilter(renamed)


SUFFIX = ".gz"
#: A file of a format that is not compressed itself may unpack to so many times its size, and to so much whatever its
#: size: a PLY whose SH coefficients are all zero comes to five times.
_MOST_TIMES, _FREE = 16, 1 << 20
#: The same for formats whose files are compressed, and hold far more splats a byte.
_MOST_TIMES_PACKED, _FREE_PACKED = 2, 1 << 14
_PART = 1 << 20
#: What a stream is called in messages.
STANDARD_INPUT = "standard input"
#: Some 70 million splats of SH degree 3 as a PLY. A file has an end, a stream need not have one.
MOST_BYTES = 1 << 34


@contextlib.contextmanager
def plain(path: Path, trust: bool = False) -> Iterator[Path]:
    """A scene as a reader takes it: a gzipped one is unpacked until the block ends, any other is left as it is.

    Args:
        path: of the scene; it need not exist.
        trust: as of :func:`unpacked`.

    Raises:
        As :func:`unpacked`, and:
        DataError: the file is a Git-LFS pointer.
    """
    refuse_lfs_pointer(path)
    with contextlib.nullcontext(path) if path.suffix.lower() != SUFFIX else unpacked(path, trust) as file:
        yield file


@contextlib.contextmanager
def unpacked(path: Path, trust: bool = False) -> Iterator[Path]:
    """A gzipped scene as a temporary file, gone when the block ends.

    What is raised over that file in the block, and logged, speaks of ``path``.

    Args:
        path: of the file, "scene.ply.gz".
        trust: whether it may unpack to far more than it is.

    Raises:
        UsageError: no format has the suffix before the last, or the file cannot be opened.
        DataError: it is damaged, or unpacks to more than a scene would.
        PotrError: there is no room for what it unpacks to.
    """
    inner = path.with_name(path.name[: -len(SUFFIX)])
    with called(os.fspath(inner), os.fspath(path)):
        packed = registry.format_of(inner).packed
    times, free = (_MOST_TIMES_PACKED, _FREE_PACKED) if packed else (_MOST_TIMES, _FREE)
    with temporary_folder() as folder:
        file = Path(folder, inner.name)
        with opened(path) as (stream, size):
            most = None if trust else times * size + free
            too_much = (
                f"'{path}' unpacks to more than {most} bytes, which no real scene does, and could fill the disk: "
                "if you know where the file comes from, read it with --trust (in Python: trust=True)"
            )
            try:
                _store(gzip.GzipFile(fileobj=stream), b"", file, most, f"unpack '{path}' into", too_much)
            except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                raise DataError(f"'{path}' is damaged or truncated: {error}") from error
        with called(os.fspath(file), os.fspath(path)):
            yield file


@contextlib.contextmanager
def received(stream: BinaryIO, suffix: str | None = None, name: str = STANDARD_INPUT) -> Iterator[Path]:
    """What a stream brings, as a temporary file.

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
        too_much = f"the {name} brings more than {MOST_BYTES} bytes: save it to a file and name that"
        _store(stream, start, path, MOST_BYTES, f"keep what the {name} brings in", too_much)
        with called(f"'{path}'", f"the {name}"):
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
        with called(f"'{path}'", "the standard output"):
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


def _store(
    stream: BinaryIO | gzip.GzipFile, start: bytes, file: Path, most: int | None, doing: str, too_much: str
) -> None:
    """Write to a new file what a stream has begun with and brings yet, ``most`` bytes at most."""
    size, part = 0, start or stream.read(_PART)
    with file.open("xb") as target:
        while part:
            size += len(part)
            if most is not None and size > most:
                raise DataError(too_much)
            try:
                target.write(part)
                target.flush()
            except OSError as error:
                raise PotrError(
                    f"cannot {doing} '{file.parent}': {error.strerror or error}: make room there, or name another "
                    "folder by the environment variable TMPDIR"
                ) from error
            part = stream.read(_PART)
