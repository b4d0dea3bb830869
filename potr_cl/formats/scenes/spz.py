"""Scenes as SPZ files (Niantic's .spz): versions 1 to 4 are read, 2 to 4 are written.

SPZ names axes of its own (right, up, back), but converters, Niantic's included, keep those of the PLY by default, and
a file rarely says which it holds. So axes are kept as they are, in both directions.
"""

from __future__ import annotations

import gzip
import logging
import os
import struct
import zlib
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.codec.quantize import canonical_rotations
from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.scene_files import MOST_A_BYTE, arranged, cleaned, opened, tell_of_low_pass, unfilled
from potr_cl.host.atomic_write import replacing
from potr_cl.host.threads import thread_pool
from potr_cl.model.claims import check_claim
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene

_log = logging.getLogger("potr_cl")

_MAGIC = b"NGSP"
#: magic, version, splats, SH degree, fractional bits of positions, flags; then a reserved byte or the number of streams
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4_BYTES = 32
_STREAM = struct.Struct("<QQ")
_ANTIALIASED, _EXTENSIONS = 1, 2
#: Versions that are one stream, usually gzipped.
_LEGACY = range(1, 4)
#: The version whose positions are half floats.
_HALF_FLOATS = 1
_LARGEST_DEGREE = 4
#: A file may have extensions behind its splats; no known one comes near.
_EXTENSION_BYTES = 1 << 20

#: Those that are written, the usual one first.
_VERSIONS = (2, 3, 4)
#: The same with what sets each apart.
VERSIONS = {
    2: "which all readers that were tried take",
    3: "with finer rotations",
    4: "smaller and for new readers only",
}
#: Of each stream of version 4.
_ZSTD_LEVEL = 12

#: Positions are integers of 24 bits with a sign; 12 of them are the fraction in all files that other tools write.
_POSITION_LIMIT = 2**23 - 1
_FRACTIONAL_BITS, _MOST_FRACTIONAL_BITS = 12, 24
_COLOUR_SCALE = 0.15
#: Of a quaternion's three smallest parts: 9 bits of magnitude below a sign, for 0 to √½.
_LARGEST_PART = 511
#: Which parts of x, y, z, w are stored, first the lowest bits, by the number of the largest, which is not.
_STORED_PARTS = np.array([[3, 2, 1], [3, 2, 0], [3, 1, 0], [2, 1, 0]])

#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16
#: gzip's header without a time, so that a scene has the same bytes whenever it is written.
_GZIP_HEADER = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\xff"
#: Long content is deflated in parts of this many bytes, side by side.
_GZIP_PART, _GZIP_LONG, _GZIP_LEVEL = 1 << 18, 1 << 20, 6

U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class _Header:
    """What stands before the splats, checked: version, number of splats, fractional bits and flags as in the file."""

    version: int
    splats: int
    degree: int
    fractional_bits: int
    flags: int
    streams: int

    @property
    def sizes(self) -> list[int]:
        """Bytes of positions, opacities, colours, scales, rotations and SH, in this order."""
        position, rotation = 6 if self.version == _HALF_FLOATS else 9, 3 if self.version < 3 else 4
        return [self.splats * size for size in (position, 1, 3, 3, rotation, 3 * ((self.degree + 1) ** 2 - 1))]


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """Read a scene from an SPZ file of version 1 to 4; versions 1 to 3 may be gzipped or not.

    Of SH degree 4, the coefficients of degree 4 are dropped.

    Args:
        path: of the file.
        trust: whether it may hold more splats a byte than a real scene has, and so take memory out of proportion.

    Returns:
        The scene, finite throughout, in the axes of the file.

    Raises:
        UsageError: there is no such file.
        DataError: it is damaged, no SPZ file, or holds too many splats for its size.
    """
    with opened(path) as (file, size):
        start = file.read(_HEADER_4_BYTES)
        file.seek(0)
        if start[:2] == b"\x1f\x8b":
            header, properties = _read_gzip(path, gzip.GzipFile(fileobj=file), size, trust)
        elif int.from_bytes(start[4:8], "little") in _LEGACY:
            header, properties = _read_gzip(path, file, size, trust)
        else:
            header, properties = _read_streams(path, file.read(), trust)
        scene = _unpacked(header, properties).rendered(bool(header.flags & _ANTIALIASED))
    if header.degree >= len(SH_COEFFICIENTS):
        _log.warning("'%s': SH degree 4 is left out: only degrees 0 to 3 are kept", path)
    if header.flags & _EXTENSIONS:
        _log.warning("'%s' has extensions: they are left out, and axes are kept as they are", path)
    return cleaned(path, scene)


def save(path: str | os.PathLike[str], scene: Scene, version: int = _VERSIONS[0]) -> None:
    """Write a scene as SPZ; the file appears under its name only when it is whole.

    Positions are stored in steps of 1/4096 unit, as every tool writes them; in a scene too large for that, coarser.

    Args:
        path: of the file.
        scene: of any SH degree.
        version: 2, rotations in 8 bits a part; 3, rotations in 10 bits; 4, the same content packed by zstd instead of
            gzip. docs/formats.md has a table of the readers that take them.

    Raises:
        UsageError: ``path`` cannot be written to.
        DataError: a position is too large for SPZ.
        PotrError: the system failed to write.
    """
    largest = float(np.abs(scene.means).max())
    bits = _FRACTIONAL_BITS
    while bits > 1 and largest * 2**bits > _POSITION_LIMIT:
        bits -= 1
    if largest * 2**bits > _POSITION_LIMIT:
        raise DataError(f"'{path}': SPZ cannot hold a splat {largest:.3g} units from the origin")
    if bits < _FRACTIONAL_BITS:
        _log.warning("'%s': the scene is large for SPZ: positions are stored in steps of 1/%d unit", path, 2**bits)
    tell_of_low_pass(path, scene)
    flags = _ANTIALIASED if scene.antialiased else 0
    properties = _packed(_well_conditioned(arranged(scene)) if version == 2 else arranged(scene), bits, version)
    streams = sum(map(bool, properties)) if version > 3 else 0
    header = _HEADER.pack(_MAGIC, version, len(scene), scene.sh_degree, bits, flags, streams)
    with replacing(path) as file:
        if version > 3:
            _write_streams(file, header, properties)
        else:
            _write_gzip(file, b"".join([header, *properties]))


FORMAT = SceneFormat(
    name="SPZ",
    suffixes=(".spz",),
    note="of Niantic; versions 1 to 4 are read, 2 to 4 are written: which readers take which stands below",
    load=load,
    save=save,
    starts=(_MAGIC,),
    gzipped=True,
    versions=_VERSIONS,
    packed=True,
)


# ---------------------------------------------------------------------------------------------------- containers


def _read_gzip(
    path: str | os.PathLike[str], stream: gzip.GzipFile | BinaryIO, size: int, trust: bool
) -> tuple[_Header, list[bytes | memoryview]]:
    """Versions 1 to 3: one stream, of which no more is unpacked than its header tells of."""
    try:
        header = _header(path, stream.read(_HEADER.size), _LEGACY, size, trust)
        properties: list[bytes | memoryview] = [stream.read(wanted) for wanted in header.sizes]
        beyond = _EXTENSION_BYTES if header.flags & _EXTENSIONS else 0
        if len(stream.read(beyond + 1)) > beyond:  # to the end, where gzip has its checksum
            raise DataError(f"'{path}' is damaged: it holds more than the splats that its header tells of")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"'{path}' is damaged or truncated: {error}") from error
    if any(len(part) < wanted for part, wanted in zip(properties, header.sizes, strict=True)):
        raise DataError(f"'{path}' is truncated: its header tells of more splats than it holds")
    return header, properties


def _read_streams(
    path: str | os.PathLike[str], content: bytes, trust: bool
) -> tuple[_Header, list[bytes | memoryview]]:
    """Version 4: a table, and a zstd frame for each property that is not empty."""
    if content[:4] != _MAGIC or len(content) < _HEADER_4_BYTES:
        raise DataError(f"'{path}' is not an SPZ file")
    header = _header(path, content[: _HEADER.size], range(4, 5), len(content), trust)
    wanted = [size for size in header.sizes if size]
    (table,) = struct.unpack_from("<I", content, _HEADER.size)
    position = table + _STREAM.size * len(wanted)
    if header.streams != len(wanted) or not _HEADER_4_BYTES <= table <= position <= len(content):
        raise DataError(f"'{path}' is damaged: its table of streams does not fit its splats")
    properties: list[bytes | memoryview] = []
    for k, size in enumerate(wanted):
        stored, said = _STREAM.unpack_from(content, table + _STREAM.size * k)
        frame = content[position : position + stored]
        # The frame has a claim of its own, which the library believes.
        if said != size or len(frame) != stored or zstandard.frame_content_size(frame) not in (size, -1):
            raise DataError(f"'{path}' is damaged: a stream of it is not as large as its splats need")
        unpacked = zstandard.ZstdDecompressor().decompress(frame, max_output_size=size)
        if len(unpacked) != size:
            raise DataError(f"'{path}' is damaged: a stream of it is not as large as its splats need")
        properties.append(unpacked)
        position += stored
    return header, [*properties, b""][:6]


def _header(path: str | os.PathLike[str], start: bytes, versions: range, size: int, trust: bool) -> _Header:
    """Check a header before memory is taken on its word."""
    if len(start) < _HEADER.size or start[:4] != _MAGIC:
        raise DataError(f"'{path}' is not an SPZ file")
    _, version, splats, degree, bits, flags, streams = _HEADER.unpack_from(start)
    if version not in versions:
        raise DataError(f"'{path}' is an SPZ file of version {version}, which is not known or not packed like this")
    if degree > _LARGEST_DEGREE:
        raise DataError(f"'{path}' has SH degree {degree}: export at most 3 bands")
    if splats == 0:
        raise DataError(f"'{path}' holds no splat")
    if version != _HALF_FLOATS and not 1 <= bits <= _MOST_FRACTIONAL_BITS:
        raise DataError(f"'{path}' is damaged: positions with {bits} fractional bits")
    try:
        check_claim(splats, size, MOST_A_BYTE, trust)
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None
    return _Header(version, splats, degree, bits, flags, streams)


def _write_gzip(file: BinaryIO, content: bytes) -> None:
    """One gzip member; its parts are deflated by themselves, which leaves it a single stream."""
    part = _GZIP_PART if len(content) >= _GZIP_LONG else len(content)
    starts = range(0, len(content), part)
    view = memoryview(content)

    def deflate(start: int) -> bytes:
        compressor = zlib.compressobj(_GZIP_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
        end = zlib.Z_FINISH if start == starts[-1] else zlib.Z_SYNC_FLUSH
        return compressor.compress(view[start : start + part]) + compressor.flush(end)

    file.write(_GZIP_HEADER)
    with thread_pool() as pool:
        for deflated in pool.map(deflate, starts):
            file.write(deflated)
    file.write(struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF))


def _write_streams(file: BinaryIO, header: bytes, properties: list[bytes]) -> None:
    """Version 4: the header up to the table, the table, and a zstd frame for each property that is not empty."""
    parts = [part for part in properties if part]
    with thread_pool() as pool:
        frames = list(pool.map(lambda part: zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(part), parts))
    start = header + struct.pack("<I", _HEADER_4_BYTES)
    file.write(start.ljust(_HEADER_4_BYTES, b"\0"))
    for part, frame in zip(parts, frames, strict=True):
        file.write(_STREAM.pack(len(frame), len(part)))
    for frame in frames:
        file.write(frame)


# ---------------------------------------------------------------------------------------------------- values


def _unpacked(header: _Header, properties: list[bytes | memoryview]) -> Scene:
    """The values of a file's bytes, block by block."""
    count, coefficients = header.splats, SH_COEFFICIENTS[min(header.degree, len(SH_COEFFICIENTS) - 1)]
    positions, opacities, colours, scales, rotations, rest = (
        np.frombuffer(part, np.uint8).reshape(count, -1) for part in properties
    )
    scene = unfilled(count, coefficients)
    byte = np.arange(256).astype(np.float32)
    least = np.float32(1e-6)
    opacity = np.clip(byte / np.float32(255), least, np.float32(1) - least)
    logits = natural_logarithm(opacity / (np.float32(1) - opacity))
    dc = (byte / np.float32(255) - np.float32(0.5)) / np.float32(_COLOUR_SCALE)
    for start in range(0, count, _BLOCK):
        block = slice(start, start + _BLOCK)
        scene.means[block] = _positions(positions[block], header)
        scene.log_scales[block] = (byte / 16 - 10).take(scales[block])
        scene.quaternions[block] = _smallest_three(rotations[block]) if header.version > 2 else _xyz(rotations[block])
        scene.opacity_logits[block] = logits.take(opacities[block, 0])
        scene.sh[block, 0] = dc.take(colours[block])
        if coefficients > 1:
            stored = rest[block, : 3 * (coefficients - 1)]
            scene.sh[block, 1:] = ((byte - 128) / 128).take(stored).reshape(-1, coefficients - 1, 3)
    return scene


def _positions(stored: U8, header: _Header) -> FloatArray:
    if header.version == _HALF_FLOATS:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float32)
    parts = stored.reshape(-1, 3, 3).astype(np.int32)
    values = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    values = (values ^ 0x800000) - 0x800000
    positions: FloatArray = values.astype(np.float32) * np.float32(2.0**-header.fractional_bits)
    return positions


def _smallest_three(stored: U8) -> FloatArray:
    """Quaternions w, x, y, z from the number of the largest part and the three others."""
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0]
    largest = (packed >> 30).astype(np.intp)
    part = np.arange(1024)
    magnitudes = np.float32(np.sqrt(0.5)) * ((part & _LARGEST_PART) / np.float32(_LARGEST_PART)).astype(np.float32)
    values = np.where(part > _LARGEST_PART, -magnitudes, magnitudes)
    others = np.stack([values.take((packed >> shift) & 1023) for shift in (0, 10, 20)], axis=1)
    xyzw = np.empty((len(packed), 4), np.float32)
    np.put_along_axis(xyzw, _STORED_PARTS[largest], others, axis=1)
    squares = others * others
    left = 1 - (squares[:, 0] + squares[:, 1] + squares[:, 2])
    np.put_along_axis(xyzw, largest[:, None], np.sqrt(np.maximum(left, 0))[:, None], axis=1)
    return xyzw[:, [3, 0, 1, 2]]


def _xyz(stored: U8) -> FloatArray:
    """Quaternions w, x, y, z from bytes of x, y, z, as versions 1 and 2 have them."""
    xyz = stored.astype(np.float32) / np.float32(127.5) - np.float32(1)
    left = 1 - (xyz * xyz).sum(axis=1)
    return np.column_stack([np.sqrt(np.maximum(left, 0)), xyz])


def _packed(scene: Scene, fractional_bits: int, version: int) -> list[bytes]:
    """The bytes of a scene with unit quaternions, property by property."""

    def as_bytes(values: NDArray[Any]) -> bytes:
        return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()

    with np.errstate(over="ignore"):  # of values far beyond what bytes hold
        steps = np.round(scene.means * np.float32(2**fractional_bits)).astype(np.int64)
        fixed = np.clip(steps, -_POSITION_LIMIT - 1, _POSITION_LIMIT).astype("<i4")
        return [
            np.ascontiguousarray(fixed.view(np.uint8).reshape(len(scene), 3, 4)[..., :3]).tobytes(),
            as_bytes(255 / (1 + np.exp(-scene.opacity_logits))),
            as_bytes(scene.sh[:, 0] * np.float32(_COLOUR_SCALE * 255) + np.float32(127.5)),
            as_bytes((scene.log_scales + np.float32(10)) * np.float32(16)),
            _packed_rotations(scene.quaternions) if version > 2 else as_bytes(_first_three(scene.quaternions)),
            as_bytes(scene.sh[:, 1:] * np.float32(128) + np.float32(128)),
        ]


def _well_conditioned(scene: Scene) -> Scene:
    """The same splats with their axes numbered such that w, which version 2 leaves to the reader, is the largest part.

    A reader takes w from the squares of the others: where it is small, their rounding would turn the splat by degrees.
    """
    imaginary, log_scales = canonical_rotations(scene.quaternions, scene.log_scales)
    real = np.sqrt(np.maximum(1 - (imaginary * imaginary).sum(axis=1), 0))
    quaternions = np.column_stack([real, imaginary]).astype(np.float32)
    return replace(scene, quaternions=quaternions, log_scales=log_scales)


def _first_three(quaternions: FloatArray) -> NDArray[Any]:
    """x, y and z of unit quaternions with w >= 0, from 0 to 255: a reader takes w from the others."""
    signs = np.where(quaternions[:, :1] < 0, np.float32(-1), np.float32(1))
    parts: NDArray[Any] = (quaternions[:, 1:] * signs + np.float32(1)) * np.float32(127.5)
    return parts


def _packed_rotations(quaternions: FloatArray) -> bytes:
    xyzw = quaternions[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw[np.take_along_axis(xyzw, largest[:, None], axis=1)[:, 0] < 0] *= -1
    others = np.take_along_axis(xyzw, _STORED_PARTS[largest], axis=1)
    parts = np.minimum(np.round(np.abs(others) * (_LARGEST_PART / np.sqrt(0.5))), _LARGEST_PART).astype(np.uint32)
    parts |= (others < 0).astype(np.uint32) << 9
    packed = parts[:, 0] | parts[:, 1] << 10 | parts[:, 2] << 20 | largest.astype(np.uint32) << 30
    stored: bytes = packed.astype("<u4").tobytes()
    return stored
