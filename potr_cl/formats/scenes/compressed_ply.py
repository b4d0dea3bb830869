"""Scenes as compressed PLY files (SuperSplat's and splat-transform's .compressed.ply), through the library gsply."""

from __future__ import annotations

import os
import re

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.gsply_arrays import EXTRA, from_scene, library, to_scene
from potr_cl.formats.scenes.scene_files import file_size, reading
from potr_cl.host.atomic_write import replacing
from potr_cl.model.scene import SH_COEFFICIENTS, Scene

_MAX_HEADER_BYTES = 1 << 16
#: Splats that share one set of bounds, and the floats that a set takes.
_CHUNK, _CHUNK_VALUES = 256, 18
_VERTEX = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed_ply(path: str | os.PathLike[str]) -> bool:
    """Whether a PLY file is a compressed one; False if it cannot be read."""
    try:
        with open(path, "rb") as file:
            head = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0]
    except (OSError, ValueError):
        return False
    return head.startswith(b"ply") and b"packed_position" in head


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene from a compressed PLY of SH degree 0 to 3.

    Raises:
        UsageError: there is no such file, or the extra ``convert`` is not installed.
        DataError: it is damaged, or of an older layout.
    """
    size = file_size(path)
    gsply = library(path)
    with reading(path):
        _check(path, size)
        data = gsply.plyread(path)
    return to_scene(path, data)


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene as compressed PLY; the file appears under its name only when it is whole.

    Raises:
        UsageError: ``path`` cannot be written to, or the extra ``convert`` is not installed.
        PotrError: the system failed to write.
    """
    gsply = library(path)
    with replacing(path) as file:
        file.write(gsply.compress_to_bytes(from_scene(gsply, scene)))


FORMAT = SceneFormat(
    name="compressed PLY",
    suffixes=(".compressed.ply",),
    note="of SuperSplat and splat-transform; a `.ply` with this content is read too",
    load=load,
    save=save,
    extra=EXTRA,
    recognises=is_compressed_ply,
)


def _check(path: str | os.PathLike[str], size: int) -> None:
    """Check the header's counts against the file's size: the library believes them."""
    with open(path, "rb") as file:
        head = file.read(_MAX_HEADER_BYTES)
    header, end, _ = head.partition(b"end_header\n")
    if not end:
        raise DataError(f"'{path}' has a damaged PLY header")
    elements: dict[str, tuple[int, list[str]]] = {}
    properties: list[str] = []
    for line in header.decode("latin-1").split("\n"):
        if match := re.fullmatch(r"element (\w+) (\d{1,10})", line.strip()):
            properties = []
            elements[match[1]] = (int(match[2]), properties)
        elif match := re.fullmatch(r"property (float|uint|uchar) (\w+)", line.strip()):
            properties.append(match[2])
    chunks, bounds = elements.get("chunk", (0, []))
    splats, vertex = elements.get("vertex", (0, []))
    lines, rest = elements.get("sh", (splats, []))
    if splats == 0:
        raise DataError(f"'{path}' holds no splat")
    if "format binary_little_endian 1.0" not in header.decode("latin-1") or tuple(vertex) != _VERTEX:
        raise DataError(f"'{path}' is no compressed PLY that can be read")
    if len(bounds) != _CHUNK_VALUES:
        raise DataError(f"'{path}' is a compressed PLY of an older layout: run 'splat-transform IN.ply OUT.ply'")
    if len(rest) not in [3 * (m - 1) for m in SH_COEFFICIENTS] or lines != splats:
        raise DataError(f"'{path}' is damaged: {lines} rows of {len(rest)} SH coefficients for {splats} splats")
    if chunks != -(-splats // _CHUNK):
        raise DataError(f"'{path}' is damaged: {chunks} chunks for {splats} splats")
    wanted = len(header) + len(end) + 4 * _CHUNK_VALUES * chunks + (16 + len(rest)) * splats
    if size < wanted:
        raise DataError(f"'{path}' is truncated: its header tells of {wanted} bytes, it has {size}")
