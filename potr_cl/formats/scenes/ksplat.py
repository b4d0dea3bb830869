"""Scenes as .ksplat files (mkkellogg's GaussianSplats3D), of every compression level and SH degree.

A file is a header of 4,096 bytes, a header of 1,024 bytes for each section, and the sections. A section's splats are
rows of one size. From level 1 on, numbers are half floats, and centres are 16-bit steps around the centre of a bucket
of splats: first the buckets that are full, then the others, whose lengths stand before the buckets' centres. Level 2
has SH coefficients in bytes between two bounds that the file names.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.scene_files import byte_logits, cleaned, log_of_scales, opened
from potr_cl.formats.scenes.splat import colours
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
#: version (2), sections (room, used), splats (room, used), level, centre (3), bounds of SH coefficients in bytes (2)
_HEADER = struct.Struct("<BBxxIIIIHxx3f2f")
#: splats (used, room), bucket size, buckets, their side, bytes of each, steps to a side, bytes of the section, full and
#: other buckets, SH degree
_SECTION = struct.Struct("<IIIIfHxxIIIIH")
_LARGEST_STEP = 32767
_SH_BOUND = 1.5
_BUCKET_BYTES = 12
#: How the coefficients of a degree stand in a row: degree after degree, and in each red, green, blue.
_DEGREES = ((1, 4), (4, 9), (9, 16))
_BYTE = np.arange(256)

U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class _Section:
    """A section's header, checked: all that it tells of lies within the file."""

    splats: int
    room: int
    bucket_size: int
    buckets: int
    side: float
    steps: int
    full: int
    others: int
    degree: int
    row: np.dtype[np.void]
    start: int
    rows_at: int


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """The scene of a .ksplat file; see :class:`potr_cl.formats.declaration.SceneLoader`."""
    with opened(path) as (file, _):
        return cleaned(path, _read(path, file.read()))


FORMAT = SceneFormat(
    name="ksplat",
    suffixes=(".ksplat",),
    note="of GaussianSplats3D: compression levels 0 to 2; scales of 0 are read as 1e-9 unit",
    load=load,
    not_written="nothing here writes .ksplat: GaussianSplats3D reads .ply and .splat too",
)


def _read(path: str | os.PathLike[str], data: bytes) -> Scene:
    if len(data) < _HEADER_BYTES:
        raise DataError(f"'{path}' is no .ksplat file: it is shorter than a header of {_HEADER_BYTES} bytes")
    major, minor, room, _, _, _, level, _, _, _, low, high = _HEADER.unpack_from(data)
    if major != 0 or minor < 1:
        raise DataError(f"'{path}' is no .ksplat file, or of version {major}.{minor}: only 0.1 is known")
    if level > 2:
        raise DataError(f"'{path}' is a .ksplat file of compression level {level}: only 0 to 2 are known")
    sections = _sections(path, data, room, level)
    count = sum(section.splats for section in sections)
    if count == 0:
        raise DataError(f"'{path}' has no splats")
    coefficients = SH_COEFFICIENTS[max(section.degree for section in sections)]
    scene = Scene.blank(count, coefficients, by_splat=True)
    scene.sh[:] = 0  # sections may be of lower degrees
    # Zero is what writers leave where they have no bounds.
    bounds = np.float32(low or -_SH_BOUND), np.float32(high or _SH_BOUND)
    start = 0
    for section in sections:
        block = slice(start, start + section.splats)
        rows = np.frombuffer(data, section.row, section.splats, section.rows_at)
        scene.means[block] = rows["mean"] if level == 0 else _centres(path, data, section, rows["mean"])
        scene.log_scales[block] = log_of_scales(rows["scale"].astype(np.float32))
        scene.quaternions[block] = rows["rotation"]
        scene.opacity_logits[block] = byte_logits().take(rows["colour"][:, 3])
        scene.sh[block, 0] = colours(rows["colour"][:, :3])
        _fill_rest(scene.sh[block], rows["rest"], section.degree, bounds)
        start = block.stop
    return scene


def _sections(path: str | os.PathLike[str], data: bytes, room: int, level: int) -> list[_Section]:
    """The sections that hold splats; those that a file only has room for are passed over."""
    at = _HEADER_BYTES + room * _SECTION_BYTES
    if at > len(data):
        raise DataError(f"'{path}' is truncated: its header tells of {room} sections")
    sections = []
    for k in range(room):
        header = _SECTION.unpack_from(data, _HEADER_BYTES + k * _SECTION_BYTES)
        splats, most, bucket_size, buckets, side, bucket_bytes, steps, _, full, others, degree = header
        if degree >= len(SH_COEFFICIENTS):
            raise DataError(f"'{path}' is damaged: a section of SH degree {degree}")
        row = _row(level, degree)
        rows_at = at + bucket_bytes * buckets + 4 * others
        end = rows_at + row.itemsize * most
        if end > len(data) or splats > most:
            raise DataError(f"'{path}' is truncated: a section announces {most} splats, more than the file has")
        if level and splats:
            if bucket_bytes != _BUCKET_BYTES or full + others > buckets or full * bucket_size > most:
                raise DataError(f"'{path}' is damaged: the buckets of a section do not fit its splats")
            if not np.isfinite(side):
                raise DataError(f"'{path}' is damaged: buckets of an impossible size")
        if splats:
            steps = steps or _LARGEST_STEP
            sections.append(
                _Section(splats, most, bucket_size, buckets, side, steps, full, others, degree, row, at, rows_at)
            )
        at = end
    return sections


def _row(level: int, degree: int) -> np.dtype[np.void]:
    number, mean = ("<f4", "<f4") if level == 0 else ("<f2", "<u2")
    rest = ("<f4", "<f2", "u1")[level]
    parts = [("mean", mean, 3), ("scale", number, 3), ("rotation", number, 4), ("colour", "u1", 4)]
    return np.dtype([*parts, ("rest", rest, 3 * (SH_COEFFICIENTS[degree] - 1))])


def _centres(path: str | os.PathLike[str], data: bytes, section: _Section, stored: NDArray[np.uint16]) -> FloatArray:
    """Centres from steps around those of the buckets."""
    lengths = np.frombuffer(data, "<u4", section.others, section.start).astype(np.int64)
    middles = np.frombuffer(data, "<f4", 3 * section.buckets, section.start + 4 * section.others).reshape(-1, 3)
    whole = section.full * section.bucket_size
    if not section.splats <= whole + lengths.sum() <= section.room:
        raise DataError(f"'{path}' is damaged: the buckets of a section do not fit its splats")
    bucket = np.concatenate(
        [
            np.arange(whole) // max(section.bucket_size, 1),
            np.repeat(np.arange(section.full, section.full + section.others), lengths),
        ]
    )[: section.splats]
    step = section.side / 2 / section.steps
    centres: FloatArray = ((stored.astype(np.float64) - section.steps) * step + middles[bucket]).astype(np.float32)
    return centres


def _fill_rest(sh: FloatArray, stored: NDArray[Any], degree: int, bounds: tuple[np.float32, np.float32]) -> None:
    """Put the coefficients of a section into (splats, coefficients, 3)."""
    if stored.dtype == np.uint8:
        low, high = bounds
        table = (low + _BYTE.astype(np.float32) / np.float32(255) * (high - low)).astype(np.float32)
        stored = table.take(stored)
    for first, end in _DEGREES[:degree]:
        part = stored[:, 3 * (first - 1) : 3 * (end - 1)].reshape(len(stored), 3, end - first)
        sh[:, first:end] = part.transpose(0, 2, 1)
