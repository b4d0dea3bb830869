"""Scenes that are gzipped (a suffix .gz behind their own): unpacked into a temporary file, which any reader takes."""

from __future__ import annotations

import contextlib
import gzip
import os
import zlib
from collections.abc import Iterator
from pathlib import Path

from potr_cl.errors import DataError, PotrError
from potr_cl.formats import registry
from potr_cl.formats.called import called
from potr_cl.formats.scenes.scene_files import opened
from potr_cl.host.inputs import refuse_lfs_pointer
from potr_cl.host.leftovers import temporary_folder

SUFFIX = ".gz"
#: A file of a format that is not compressed itself may unpack to so many times its size, and to so much whatever its
#: size: a PLY whose SH coefficients are all zero comes to five times.
_MOST_TIMES, _FREE = 16, 1 << 20
#: The same for formats whose files are compressed, and hold far more splats a byte.
_MOST_TIMES_PACKED, _FREE_PACKED = 2, 1 << 14
_PART = 1 << 20


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
    if path.suffix.lower() != SUFFIX:
        yield path
        return
    with unpacked(path, trust) as file:
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
            try:
                _unpack(path, gzip.GzipFile(fileobj=stream), file, most)
            except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                raise DataError(f"'{path}' is damaged or truncated: {error}") from error
        with called(os.fspath(file), os.fspath(path)):
            yield file


def _unpack(path: Path, stream: gzip.GzipFile, file: Path, most: int | None) -> None:
    size = 0
    with file.open("xb") as target:
        while part := stream.read(_PART):
            size += len(part)
            if most is not None and size > most:
                raise DataError(
                    f"'{path}' unpacks to more than {most} bytes, which no real scene does, and could fill the disk: "
                    "if you know where the file comes from, read it with --trust (in Python: trust=True)"
                )
            try:
                target.write(part)
            except OSError as error:
                raise PotrError(
                    f"cannot unpack '{path}' into '{file.parent}': {error.strerror or error}: make room there, or name "
                    "another folder by the environment variable TMPDIR"
                ) from error
