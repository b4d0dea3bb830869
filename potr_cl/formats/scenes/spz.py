"""Scenes as SPZ files (Niantic's .spz): versions 1 to 4 are read, 2 to 4 are written.

SPZ names axes of its own (right, up, back), but converters, Niantic's included, keep those of the PLY by default, and
a file rarely says which it holds. So axes are kept as they are, in both directions.
"""

from __future__ import annotations

import gzip
import io
import logging
import os
import struct
import zlib
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.scene_files import arranged, check_splats, cleaned, opened, tell_of_low_pass
from potr_cl.formats.scenes.spz_values import HALF_FLOATS, MOST_FRACTIONAL_BITS, POSITION_LIMIT, packed, unpacked
from potr_cl.host.atomic_write import write_pieces
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import SH_COEFFICIENTS, Scene

_log = logging.getLogger("potr_cl")

_MAGIC = b"NGSP"
#: magic, version, splats, SH degree, fractional bits of positions, flags; then a reserved byte or the number of streams
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4_BYTES = 32
_STREAM = struct.Struct("<QQ")
_ANTIALIASED, _EXTENSIONS = 1, 2
#: Versions that are one stream, usually gzipped.
_LEGACY = range(1, 4)
_LARGEST_DEGREE = 4
#: A file may have extensions behind its splats; no known one comes near.
_EXTENSION_BYTES = 1 << 20

#: Those that are written, the usual one first.
_VERSIONS = (2, 3, 4)
#: The same with what sets each apart.
VERSIONS = {2: "read by every tool we tested", 3: "with finer rotations", 4: "packed by zstd, for new readers only"}
#: Of each stream of version 4. Level 12 takes twice as long for 1 % less.
_ZSTD_LEVEL = 8

#: Of positions, in all files that other tools write.
_FRACTIONAL_BITS = 12
#: gzip's header without a time, so that a scene has the same bytes whenever it is written.
_GZIP_HEADER = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\xff"
#: Content is deflated in parts of this many bytes, side by side.
_GZIP_PART = 1 << 18
#: How each property is deflated: level and strategy. Opacities, scales and rotations hold few repetitions but runs:
#: to look for others takes 10 times as long, and more bytes, because symbols of lengths spoil the code of the others.
_DEFLATE = (
    (5, zlib.Z_DEFAULT_STRATEGY),
    (6, zlib.Z_RLE),
    (5, zlib.Z_DEFAULT_STRATEGY),
    (6, zlib.Z_RLE),
    (6, zlib.Z_RLE),
    (5, zlib.Z_DEFAULT_STRATEGY),
)


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
        position, rotation = 6 if self.version == HALF_FLOATS else 9, 3 if self.version < 3 else 4
        return [self.splats * size for size in (position, 1, 3, 3, rotation, 3 * ((self.degree + 1) ** 2 - 1))]


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """A scene in an SPZ file of version 1 to 4, in its axes; see :class:`potr_cl.formats.declaration.SceneLoader`.

    Versions 1 to 3 may be gzipped or not. Of SH degree 4, the coefficients of degree 4 are dropped.
    """
    with opened(path) as (file, size):
        return cleaned(path, read(path, file, size, trust))


def read(path: str | os.PathLike[str], file: BinaryIO, size: int, trust: bool) -> Scene:
    """The same from an open file of so many bytes, as the file has it: values need not be finite.

    Args:
        path: for messages.
        file: that begins with SPZ, and ends behind it.
        size: of the file, bytes.
        trust: as of :func:`load`.
    """
    start = file.read(_HEADER_4_BYTES)
    file.seek(0)
    if start[:2] == b"\x1f\x8b":
        header, properties = _read_gzip(path, gzip.GzipFile(fileobj=file), size, trust)
    elif int.from_bytes(start[4:8], "little") in _LEGACY:
        header, properties = _read_gzip(path, file, size, trust)
    else:
        header, properties = _read_streams(path, file.read(), trust)
    coefficients = SH_COEFFICIENTS[min(header.degree, len(SH_COEFFICIENTS) - 1)]
    scene = unpacked(properties, header.splats, coefficients, header.version, header.fractional_bits)
    if header.degree >= len(SH_COEFFICIENTS):
        _log.warning("'%s': SH degree 4 is left out: only degrees 0 to 3 are kept", path)
    if header.flags & _EXTENSIONS:
        _log.warning("'%s' has extensions: they are left out, and axes are kept as they are", path)
    return scene.rendered(bool(header.flags & _ANTIALIASED))


def save(path: str | os.PathLike[str], scene: Scene, version: int = _VERSIONS[0]) -> None:
    """Write a scene as SPZ; see :class:`potr_cl.formats.declaration.SceneSaver`.

    Positions are stored in steps of 1/4096 unit, as every tool writes them; in a scene too large for that, coarser.

    Args:
        path, scene: as of a SceneSaver.
        version: 2, rotations in 8 bits a part; 3, rotations in 10 bits; 4, the same content packed by zstd instead of
            gzip. docs/formats.md has a table of the readers that take them.
    """
    write_pieces(path, content_of(path, scene, version))


def content_of(path: str | os.PathLike[str], scene: Scene, version: int = _VERSIONS[0]) -> list[bytes]:
    """What :func:`save` writes, in pieces; ``path`` is for messages.

    Raises:
        DataError: a position is too large for SPZ.
    """
    largest = float(np.abs(scene.means).max())
    bits = _FRACTIONAL_BITS
    while bits > 1 and largest * 2**bits > POSITION_LIMIT:
        bits -= 1
    if largest * 2**bits > POSITION_LIMIT:
        raise DataError(f"'{path}': SPZ cannot hold a splat {largest:.3g} units from the origin")
    if bits < _FRACTIONAL_BITS:
        _log.warning("'%s': the scene is large for SPZ: positions are stored in steps of 1/%d unit", path, 2**bits)
    tell_of_low_pass(path, scene)
    return pieces(packed(arranged(scene), bits, version), scene, bits, version)


def pieces(properties: list[bytes], scene: Scene, fractional_bits: int, version: int) -> list[bytes]:
    """A file's bytes, to be written one after another.

    Args:
        properties: of :func:`potr_cl.formats.scenes.spz_values.packed`.
        scene: whose number of splats, SH degree and way of rendering the file tells.
        fractional_bits, version: of the file.
    """
    flags = _ANTIALIASED if scene.antialiased else 0
    streams = sum(map(bool, properties)) if version > 3 else 0
    header = _HEADER.pack(_MAGIC, version, len(scene), scene.sh_degree, fractional_bits, flags, streams)
    return _streams(header, properties) if version > 3 else _gzipped(header, properties)


def part(data: bytes, rows: NDArray[np.int64]) -> list[bytes]:
    """Some splats of a gzipped file as one of their own, in pieces; nothing is rounded anew.

    Args:
        data: the file, of version 2 or 3, that this package has written.
        rows: (n,) the numbers of the splats in it.
    """
    header, properties = _read_gzip("", gzip.GzipFile(fileobj=io.BytesIO(data)), len(data), True)
    own = [np.frombuffer(each, np.uint8).reshape(header.splats, -1)[rows].tobytes() for each in properties]
    bits = header.fractional_bits
    return _gzipped(_HEADER.pack(_MAGIC, header.version, len(rows), header.degree, bits, header.flags, 0), own)


def stream_sizes(data: bytes) -> dict[str, int]:
    """Bytes of a file of version 4 by what they are for; nothing for other versions, which are packed as one."""
    if data[:4] != _MAGIC:
        return {}
    _, _, _, _, _, _, streams = _HEADER.unpack_from(data)
    (table,) = struct.unpack_from("<I", data, _HEADER.size)
    sizes = [_STREAM.unpack_from(data, table + _STREAM.size * k)[0] for k in range(streams)]
    named = dict(zip(("position", "opacity", "colour: DC", "scale", "rotation", "colour: AC"), sizes, strict=False))
    return {**named, "other": len(data) - sum(sizes)}


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
        raise DataError(f"'{path}' is an SPZ file of version {version}, which is unknown or not packed like this")
    if degree > _LARGEST_DEGREE:
        raise DataError(f"'{path}' has SH degree {degree}: export at most 3 bands")
    if splats == 0:
        raise DataError(f"'{path}' has no splats")
    if version != HALF_FLOATS and not 1 <= bits <= MOST_FRACTIONAL_BITS:
        raise DataError(f"'{path}' is damaged: positions with {bits} fractional bits")
    check_splats(path, splats, size, trust)
    return _Header(version, splats, degree, bits, flags, streams)


def _gzipped(header: bytes, properties: list[bytes]) -> list[bytes]:
    """One gzip member; its parts are deflated by themselves, which leaves it a single stream."""
    parts = [
        (content[start : start + _GZIP_PART], *how)
        for content, how in [
            (memoryview(header), _DEFLATE[0]),
            *zip([memoryview(part) for part in properties], _DEFLATE, strict=True),
        ]
        for start in range(0, len(content), _GZIP_PART)
    ]

    def deflate(number: int) -> bytes:
        part, level, strategy = parts[number]
        compressor = zlib.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS, strategy=strategy)
        end = zlib.Z_FINISH if number == len(parts) - 1 else zlib.Z_SYNC_FLUSH
        return compressor.compress(part) + compressor.flush(end)

    with thread_pool() as pool:
        packed = list(pool.map(deflate, range(len(parts))))
    checksum, size = 0, 0
    for part, _, _ in parts:
        checksum, size = zlib.crc32(part, checksum), size + len(part)
    return [_GZIP_HEADER, *packed, struct.pack("<II", checksum, size & 0xFFFFFFFF)]


def _streams(header: bytes, properties: list[bytes]) -> list[bytes]:
    """Version 4: the header up to the table, the table, and a zstd frame for each property that is not empty."""
    parts = [part for part in properties if part]
    # With threads of its own, one or many, zstd makes the same bytes.
    compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL, threads=os.cpu_count() or 1)
    frames = [compressor.compress(part) for part in parts]
    start = header + struct.pack("<I", _HEADER_4_BYTES)
    table = [_STREAM.pack(len(frame), len(part)) for part, frame in zip(parts, frames, strict=True)]
    return [start.ljust(_HEADER_4_BYTES, b"\0"), *table, *frames]
