"""Scenes as SPZ files (Niantic's .spz), through the library gsply: versions 1 to 4 are read, version 3 is written.

SPZ names axes of its own (right, up, back), but converters, Niantic's included, keep those of the PLY by default, and
a file rarely says which it holds. So axes are kept as they are, in both directions.
"""

from __future__ import annotations

import gzip
import logging
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import zstandard

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.gsply_arrays import EXTRA, from_scene, library, to_scene
from potr_cl.formats.scenes.scene_files import file_size, reading
from potr_cl.host.atomic_write import replacing
from potr_cl.host.leftovers import temporary_folder
from potr_cl.model.scene import SH_COEFFICIENTS, Scene

_log = logging.getLogger("potr_cl")

_MAGIC = b"NGSP"
#: magic, version, splats, SH degree, fractional bits of positions, flags; then a reserved byte or the number of streams
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4_BYTES = 32
_STREAM = struct.Struct("<QQ")
#: Bytes a splat of positions, opacities, colours and scales.
_FIXED_BYTES = 16
_ANTIALIASED, _EXTENSIONS = 1, 2
#: A file may have extensions behind its splats; no known one comes near.
_EXTENSION_BYTES = 1 << 20
#: Nothing that tells splats apart packs better than this (deflate's own limit).
_MOST_RATIO = 1032
_BLOCK = 1 << 20

#: Positions are integers of 24 bits with a sign; 12 of them are the fraction in all files that other tools write.
_POSITION_LIMIT = 2**23 - 1
_FRACTIONAL_BITS = 12


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene from an SPZ file of version 1 to 4 and SH degree 0 to 3.

    Returns:
        The scene, finite throughout, in the axes of the file.

    Raises:
        UsageError: there is no such file, or the extra ``convert`` is not installed.
        DataError: it is damaged or no SPZ file.
    """
    size = file_size(path)
    gsply = library(path)
    with reading(path):
        flags = _check(path, size)
        data = gsply.spz.read_spz(path)
    if flags & _ANTIALIASED:
        _log.warning("'%s' was trained for a rasterizer with antialiasing: it is rendered without", path)
    if flags & _EXTENSIONS:
        _log.warning("'%s' has extensions: they are left out, and axes are kept as they are", path)
    return to_scene(path, data)


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene as SPZ, version 3; the file appears under its name only when it is whole.

    Positions are stored in steps of 1/4096 unit, as every tool writes them; in a scene too large for that, coarser.

    Raises:
        UsageError: ``path`` cannot be written to, or the extra ``convert`` is not installed.
        DataError: a position is too large for SPZ.
        PotrError: the system failed to write.
    """
    gsply = library(path)
    largest = float(np.abs(scene.means).max())
    bits = _FRACTIONAL_BITS
    while bits > 1 and largest * 2**bits > _POSITION_LIMIT:
        bits -= 1
    if largest * 2**bits > _POSITION_LIMIT:
        raise DataError(f"'{path}': SPZ cannot hold a splat {largest:.3g} units from the origin")
    if bits < _FRACTIONAL_BITS:
        _log.warning("'%s': the scene is large for SPZ: positions are stored in steps of 1/%d unit", path, 2**bits)
    with replacing(path) as file, temporary_folder() as folder:
        temporary = Path(folder) / "scene.spz"
        gsply.spz.write_spz(temporary, from_scene(gsply, scene), version=3, fractional_bits=bits)
        with temporary.open("rb") as written:
            shutil.copyfileobj(written, file)


FORMAT = SceneFormat(
    name="SPZ",
    suffixes=(".spz",),
    note="of Niantic; versions 1 to 4 are read, version 3, which every reader knows, is written",
    load=load,
    save=save,
    extra=EXTRA,
)


def _check(path: str | os.PathLike[str], size: int) -> int:
    """Check a file's sizes before memory is taken on their word; return its flags."""
    with open(path, "rb") as file:
        start = file.read(_HEADER_4_BYTES)
        if start[:2] == b"\x1f\x8b":
            file.seek(0)
            return _check_gzip(path, gzip.GzipFile(fileobj=file), size)
        if start[:4] != _MAGIC or len(start) < _HEADER_4_BYTES:
            raise DataError(f"'{path}' is not an SPZ file")
        content = start + file.read()
    sizes, flags, streams = _streams(path, start, size)
    (directory,) = struct.unpack_from("<I", start, _HEADER.size)
    position = directory + _STREAM.size * streams
    for k in range(streams):
        stored, _ = _STREAM.unpack_from(content, directory + _STREAM.size * k)
        said = zstandard.frame_content_size(content[position : position + 18])
        if said > max(sizes):
            raise DataError(f"'{path}' is damaged: a stream of it would be larger than its splats need")
        position += stored
    return flags


def _check_gzip(path: str | os.PathLike[str], stream: gzip.GzipFile, size: int) -> int:
    start = stream.read(_HEADER.size)
    sizes, flags, _ = _streams(path, start, size)
    most = sum(sizes) + (_EXTENSION_BYTES if flags & _EXTENSIONS else 0)
    found = 0
    try:
        while block := stream.read(_BLOCK):
            found += len(block)
            if found > most:
                raise DataError(f"'{path}' is damaged: it holds more than the splats that its header tells of")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"'{path}' is damaged or truncated: {error}") from error
    if found < sum(sizes):
        raise DataError(f"'{path}' is truncated: its header tells of more splats than it holds")
    return flags


def _streams(path: str | os.PathLike[str], start: bytes, size: int) -> tuple[list[int], int, int]:
    """From a header: the bytes of SH and of all else before coding, the flags, the number of streams in version 4."""
    if len(start) < _HEADER.size or start[:4] != _MAGIC:
        raise DataError(f"'{path}' is not an SPZ file")
    _, version, splats, degree, _, flags, streams = _HEADER.unpack_from(start)
    if degree >= len(SH_COEFFICIENTS):
        raise DataError(f"'{path}' has SH degree {degree}: export at most 3 bands")
    if splats == 0:
        raise DataError(f"'{path}' holds no splat")
    rotation = 3 if version < 3 else 4
    sizes = [3 * (SH_COEFFICIENTS[degree] - 1) * splats, (_FIXED_BYTES + rotation) * splats]
    if sum(sizes) > _MOST_RATIO * size:
        raise DataError(f"'{path}' is damaged or truncated: its {size} bytes cannot hold {splats} splats")
    return sizes, flags, streams
