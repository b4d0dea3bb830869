"""Scenes as compressed PLY files (SuperSplat's and splat-transform's .compressed.ply). Headers are read strictly."""

from __future__ import annotations

import io
import os
import re
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.compressed_ply_values import (
    CHUNK,
    PackedGeometry,
    element_bytes,
    in_chunks,
    packed_colours,
    packed_geometry,
    packed_sh,
    unpacked,
)
from potr_cl.formats.scenes.ply_antialiasing import ANTIALIASED_COMMENT, marked
from potr_cl.formats.scenes.scene_files import cleaned, opened, tell_of_low_pass, unit_quaternions
from potr_cl.host.atomic_write import write_pieces
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene

_MAX_HEADER_BYTES = 1 << 16
#: What the splats of a chunk share.
_BOUNDS = [
    ("float", f"{end}_{name}")
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
]
_VERTEX = [("uint", f"packed_{name}") for name in ("position", "rotation", "scale", "color")]
_FORMAT = "format binary_little_endian 1.0"


def is_compressed_ply(path: str | os.PathLike[str]) -> bool:
    """Whether a PLY file is a compressed one; False if it cannot be read."""
    try:
        with open(path, "rb") as file:
            head = file.read(_MAX_HEADER_BYTES).partition(b"\nend_header\n")[0]
    except (OSError, ValueError):
        return False
    return head.startswith(b"ply") and re.search(rb"^\s*property\s+\S+\s+packed_position\s*$", head, re.M) is not None


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """The scene of a compressed PLY of SH degree 0 to 3; see :class:`potr_cl.formats.declaration.SceneLoader`."""
    with opened(path) as (file, size):
        return _read(path, file, size)


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene as compressed PLY; see :class:`potr_cl.formats.declaration.SceneSaver`."""
    tell_of_low_pass(path, scene)
    scene = unit_quaternions(scene.subset(in_chunks(scene.means)))
    packed, colours = packed_geometry(scene), packed_colours(scene.sh[:, 0])
    write_pieces(path, pieces(packed, colours, packed_sh(scene.sh[:, 1:]), scene.antialiased))


def pieces(
    packed: PackedGeometry, colours: tuple[FloatArray, NDArray[np.uint32]], sh: NDArray[np.uint8], antialiased: bool
) -> list[bytes]:
    """A file's bytes, to be written one after another.

    Args:
        packed, colours, sh: of :mod:`potr_cl.formats.scenes.compressed_ply_values`.
        antialiased: what a comment says of the scene.
    """
    splats, rest = len(packed.positions), 3 * sh.shape[1]
    comments = [f"comment {ANTIALIASED_COMMENT}"] if antialiased else []
    header = _header(
        [("chunk", len(packed.means), _BOUNDS), ("vertex", splats, _VERTEX), ("sh", splats, _coefficients(rest))],
        comments,
    )
    return [header, *element_bytes(packed, colours, sh)]


def scene_of(data: bytes) -> Scene:
    """The scene of a file that :func:`pieces` has made."""
    return _read("file in memory", io.BytesIO(data), len(data))


def _header(elements: list[tuple[str, int, list[tuple[str, str]]]], comments: list[str]) -> bytes:
    lines = ["ply", _FORMAT, *comments]
    for name, rows, properties in elements:
        if properties:
            lines += [f"element {name} {rows}", *(f"property {kind} {value}" for kind, value in properties)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


FORMAT = SceneFormat(
    name="compressed PLY",
    suffixes=(".compressed.ply",),
    note="of SuperSplat and splat-transform; a `.ply` with this content is read too",
    load=load,
    save=save,
    recognises=is_compressed_ply,
)


def _read(path: str | os.PathLike[str], file: BinaryIO, size: int) -> Scene:
    lines, comments, start = _header_lines(path, file.read(_MAX_HEADER_BYTES))
    chunks, splats, rest = _counts(path, lines)
    sizes = (4 * len(_BOUNDS) * chunks, 4 * len(_VERTEX) * splats, rest * splats)
    if size < start + sum(sizes):
        raise DataError(f"'{path}' is truncated: its header tells of {start + sum(sizes)} bytes, it has {size}")
    file.seek(start)
    elements = [file.read(nbytes) for nbytes in sizes]
    if sum(map(len, elements)) < sum(sizes):
        raise DataError(f"'{path}' became shorter while it was read")
    return marked(cleaned(path, unpacked(*elements)), comments)


def _header_lines(path: str | os.PathLike[str], head: bytes) -> tuple[list[str], list[str], int]:
    """The lines between the first and the last of a header, its comments, and where the values start."""
    lines: list[str] = []
    comments: list[str] = []
    start = 0
    while (end := head.find(b"\n", start)) >= 0:
        line = head[start:end].decode("latin-1")
        start = end + 1
        if line == "end_header" and lines[:1] == ["ply"]:
            return lines[1:], comments, start
        if line.startswith(("comment ", "obj_info ")) or line == "comment":
            comments.append(line.partition(" ")[2])
        else:
            lines.append(line)
    raise DataError(f"'{path}' has a damaged PLY header")


def _counts(path: str | os.PathLike[str], lines: list[str]) -> tuple[int, int, int]:
    """Rows of the elements chunk and vertex, and SH coefficients a splat, of a header that has nothing else in it."""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[1:]:
        if match := re.fullmatch(r"element (chunk|vertex|sh) ([0-9]{1,10})", line):
            elements.append((match[1], int(match[2]), []))
        elif elements and (match := re.fullmatch(r"property (float|uint|uchar) ([a-z0-9_]+)", line)):
            elements[-1][2].append((match[1], match[2]))
        else:
            raise DataError(f"'{path}' is no compressed PLY that can be read: its header has the line {line[:60]!r}")
    names = [name for name, _, _ in elements]
    if lines[:1] != [_FORMAT] or names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]):
        raise DataError(f"'{path}' is no compressed PLY that can be read")
    (_, chunks, bounds), (_, splats, vertex) = elements[:2]
    _, rows, rest = elements[2] if elements[2:] else ("sh", splats, [])
    if splats == 0:
        raise DataError(f"'{path}' has no splats")
    if vertex != _VERTEX:
        raise DataError(f"'{path}' is no compressed PLY that can be read")
    if bounds != _BOUNDS:
        raise DataError(f"'{path}' is a compressed PLY of an older layout: run 'splat-transform IN.ply OUT.ply'")
    if len(rest) not in [3 * (m - 1) for m in SH_COEFFICIENTS] or rest != _coefficients(len(rest)) or rows != splats:
        raise DataError(f"'{path}' is damaged: {rows} rows of {len(rest)} SH coefficients for {splats} splats")
    if chunks != -(-splats // CHUNK):
        raise DataError(f"'{path}' is damaged: {chunks} chunks for {splats} splats")
    return chunks, splats, len(rest)


def _coefficients(rest: int) -> list[tuple[str, str]]:
    return [("uchar", f"f_rest_{i}") for i in range(rest)]
