"""Scenes as compressed PLY files (SuperSplat's and splat-transform's .compressed.ply), read through the library gsply.

The library unpacks without looking at the bounds of its arrays. So it never sees a header of somebody else: this module
reads one, strictly, and hands on a header of its own with exactly the bytes that belong to it.
"""

from __future__ import annotations

import itertools
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
from potr_cl.formats.scenes.gsply_arrays import EXTRA, library, to_scene
from potr_cl.formats.scenes.ply_antialiasing import ANTIALIASED_COMMENT, marked
from potr_cl.formats.scenes.scene_files import cleaned, opened, tell_of_low_pass, unit_quaternions
from potr_cl.host.atomic_write import replacing
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
    """Read a scene from a compressed PLY of SH degree 0 to 3.

    Args:
        path: of the file.
        trust: of no meaning here: nothing in a compressed PLY expands.

    Raises:
        UsageError: there is no such file, or the extra ``convert`` is not installed.
        DataError: it is damaged, or of an older layout.
    """
    with opened(path) as (file, size):
        gsply = library(path)
        content, comments = _canonical(path, file, size)
        data = gsply.decompress_from_bytes(content)
    return marked(to_scene(path, data), comments)


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene as compressed PLY; the file appears under its name only when it is whole.

    Raises:
        UsageError: ``path`` cannot be written to.
        PotrError: the system failed to write.
    """
    tell_of_low_pass(path, scene)
    scene = unit_quaternions(scene.subset(in_chunks(scene.means)))
    packed, colours = packed_geometry(scene), packed_colours(scene.sh[:, 0])
    with replacing(path) as file:
        for piece in pieces(packed, colours, packed_sh(scene.sh[:, 1:]), scene.antialiased):
            file.write(piece)


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
    """The scene of a file that :func:`pieces` has made, without any library.

    Raises:
        DataError: it is damaged.
    """
    lines, comments, start = _header_lines("file in memory", data[:_MAX_HEADER_BYTES])
    chunks, splats, rest = _counts("file in memory", lines)
    ends = np.cumsum([start, 4 * len(_BOUNDS) * chunks, 4 * len(_VERTEX) * splats, rest * splats])
    if len(data) != ends[-1]:
        raise DataError(f"a compressed PLY of {len(data)} bytes should have {ends[-1]}")
    parts = (data[first:end] for first, end in itertools.pairwise(ends))
    return marked(cleaned("file in memory", unpacked(*parts)), comments)


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
    extra=EXTRA,
    recognises=is_compressed_ply,
)


def _canonical(path: str | os.PathLike[str], file: BinaryIO, size: int) -> tuple[bytearray, list[str]]:
    """A file with a header of our own, and the comments of its own.

    Not as bytes: the library's kernels are compiled for arrays that can change.
    """
    lines, comments, start = _header_lines(path, file.read(_MAX_HEADER_BYTES))
    chunks, splats, rest = _counts(path, lines)
    elements = [("chunk", chunks, _BOUNDS), ("vertex", splats, _VERTEX), ("sh", splats, _coefficients(rest))]
    whole = bytearray(_header(elements, []))
    values = 4 * len(_BOUNDS) * chunks + (4 * len(_VERTEX) + rest) * splats
    if size < start + values:
        raise DataError(f"'{path}' is truncated: its header tells of {start + values} bytes, it has {size}")
    file.seek(start)
    content = file.read(values)
    if len(content) < values:
        raise DataError(f"'{path}' became shorter while it was read")
    whole += content
    return whole, comments


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
