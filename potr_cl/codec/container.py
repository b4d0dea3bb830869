"""The .potr container: header, sections, entropy coding and integrity. docs/format.md is the normative description.

Knows bytes and integers only: what the integers mean is the encoder's and the decoder's business.
"""

from __future__ import annotations

import enum
import math
import struct
import zlib
from dataclasses import dataclass, field

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.model.scene import SH_COEFFICIENTS

MAGIC = b"POTR\r\n\x1a\n"
#: The newest version that is read; which one is written depends on the quantiser.
VERSION = 2
#: Longest metadata that a reader accepts, bytes.
MAX_METADATA = 1 << 16

_FIXED = struct.Struct("<8sHHIQQBBHI8d8s8s")
_FACTOR = struct.Struct("<d")
_ENTRY = struct.Struct("<BBBBIQQ")
_CRC = struct.Struct("<I")


class Property(enum.IntEnum):
    """What a section holds."""

    METADATA = 0
    OCCUPANCY = 1
    SEVERAL = 2
    MULTIPLICITY = 3
    TAIL_LENGTH = 4
    TAIL = 5
    SCALE = 16
    ROTATION = 17
    OPACITY = 18
    SH = 19


class Coder(enum.IntEnum):
    """How a section's bytes are stored."""

    RAW = 0
    ZSTD = 1
    DEFLATE = 2
    CONTEXT = 3


#: The most that a coder's format can expand one stored byte to: a claim beyond is a lie, found before memory is taken.
_MOST_EXPANSION = {Coder.RAW: 1, Coder.ZSTD: 1 << 15, Coder.DEFLATE: 1032, Coder.CONTEXT: 1 << 15}

#: Property -> (indices allowed, True if it holds one integer a splat)
_INDICES = {
    Property.METADATA: 1,
    Property.OCCUPANCY: 1,
    Property.SEVERAL: 1,
    Property.MULTIPLICITY: 1,
    Property.TAIL_LENGTH: 1,
    Property.TAIL: 1,
    Property.SCALE: 3,
    Property.ROTATION: 3,
    Property.OPACITY: 1,
    Property.SH: 48,
}
_SIGNED = {Property.ROTATION, Property.SH}
_A_SPLAT = {Property.SCALE, Property.ROTATION, Property.OPACITY, Property.SH}


def context_groups(prop: Property, degree: int) -> list[tuple[int, int]]:
    """First index and number of the streams that one section of coder CONTEXT holds: the sections that there can be."""
    if prop == Property.SH:
        return [(3 * band**2, 3 * (2 * band + 1)) for band in range(degree + 1)]
    if prop in _A_SPLAT:
        return [(0, _INDICES[prop])]
    return []


@dataclass(frozen=True)
class Section:
    """One entry of the section table.

    Attributes:
        kind: what it holds.
        index: axis of a scale or rotation; 3 · coefficient + channel of an SH stream; else 0.
        coder: how it is stored.
        planes: bytes an integer; coder CONTEXT: streams in the section, ``index`` the first one's.
        crc: CRC-32 of the stored bytes.
        raw_bytes, stored_bytes: sizes before and after the coder; CONTEXT: ``raw_bytes`` is the number of integers.
        offset: of the stored bytes in the file.
    """

    kind: Property
    index: int
    coder: Coder
    planes: int
    crc: int
    raw_bytes: int
    stored_bytes: int
    offset: int = 0

    @property
    def name(self) -> str:
        """For messages and tables."""
        return self.kind.name.lower() + (f" {self.index}" if _INDICES[self.kind] > 1 else "")


@dataclass(frozen=True)
class Header:
    """All that a file says of itself outside its sections.

    Attributes:
        splats: number of splats, >= 1.
        sh_degree: 0 to 3.
        origin, side, depth: root cube and deepest level of the octree (:class:`potr_cl.codec.octree.OctreeStreams`).
        sf_scale, sf_rotation, sf_opacity, sf_dc, sf_ac: scale factors; version 1 has one for all of SH.
        sections: in the order of their bytes.
    """

    version: int
    splats: int
    sh_degree: int
    origin: tuple[float, float, float]
    side: float
    depth: int
    sf_scale: float
    sf_rotation: float
    sf_opacity: float
    sf_dc: float
    sf_ac: float
    sections: tuple[Section, ...] = field(default=())

    def find(self, prop: Property, index: int = 0) -> Section | None:
        """The section of a property, None where the file has none (all of its integers are 0)."""
        return self._by_key.get((prop, index))

    @property
    def _by_key(self) -> dict[tuple[Property, int], Section]:
        cached: dict[tuple[Property, int], Section] | None = self.__dict__.get("_sections_by_key")
        if cached is None:
            cached = {(s.kind, s.index): s for s in self.sections}
            self.__dict__["_sections_by_key"] = cached
        return cached


# ------------------------------------------------------------------------------------------------ integers


def pack_integers(values: NDArray[np.integer], signed: bool) -> tuple[bytes, int]:
    """Integers to byte planes, lowest byte first; zig-zag mapped (0, −1, 1, −2, …) if signed.

    Returns:
        The planes one after another, and their number: the fewest that hold the largest integer, 0 if all are 0.
    """
    wide = values.astype(np.int64)
    mapped = ((wide << 1) ^ (wide >> 63)).view(np.uint64) if signed else wide.view(np.uint64)
    planes = (int(mapped.max(initial=0)).bit_length() + 7) // 8
    columns = mapped.astype("<u8", copy=False).view(np.uint8).reshape(-1, 8)
    return b"".join(columns[:, p].tobytes() for p in range(planes)), planes


def unpack_integers(raw: NDArray[np.uint8], planes: int, signed: bool, start: int, stop: int) -> NDArray[np.integer]:
    """Integers ``start`` to ``stop`` of byte planes, in the narrowest integer type that holds that many planes."""
    count = len(raw) // planes if planes else 0
    if planes == 0:
        return np.zeros(stop - start, np.int8)
    if planes == 1:
        mapped: NDArray[np.unsignedinteger] = raw[start:stop]
    else:
        dtype = np.uint16 if planes == 2 else np.uint32 if planes <= 4 else np.uint64
        mapped = raw[(planes - 1) * count + start : (planes - 1) * count + stop].astype(dtype)
        for p in reversed(range(planes - 1)):
            mapped <<= dtype(8)
            mapped |= raw[p * count + start : p * count + stop]
    if not signed:
        return mapped
    half = mapped >> mapped.dtype.type(1)
    sign = mapped & mapped.dtype.type(1)
    # 0 − 1 wraps round to all ones, as it should.
    np.subtract(mapped.dtype.type(0), sign, out=sign)
    half ^= sign
    return half.view(half.dtype.str.replace("u", "i"))


# ------------------------------------------------------------------------------------------------ entropy coding


ENTROPY_CODERS = ("context", "zstd", "npz")


@dataclass(frozen=True)
class EntropyCoder:
    """The entropy stage.

    "context": :mod:`potr_cl.codec.context_coder` for all that there is one of a splat, zstd for the rest; format
    version 2 only, version 1 takes zstd. "zstd" at a level (1 to 22). "npz": deflate at zlib's default level, which is
    what .npz holds.

    Raises:
        UsageError: unknown name or level.
    """

    name: str = "context"
    level: int = 19

    def __post_init__(self) -> None:
        if self.name not in ENTROPY_CODERS:
            raise UsageError(f"entropy coder '{self.name}' is unknown: choose one of {', '.join(ENTROPY_CODERS)}")
        if not 1 <= self.level <= 22:
            raise UsageError(f"zstd level {self.level} is unknown: choose 1 to 22")

    def section(self, prop: Property, index: int, raw: bytes, planes: int) -> tuple[Section, bytes]:
        """Code a section's bytes; stored as they are where coding does not make them smaller."""
        if self.name != "npz":
            coder, stored = Coder.ZSTD, zstandard.ZstdCompressor(level=self.level, write_checksum=False).compress(raw)
        else:
            coder, stored = Coder.DEFLATE, zlib.compress(raw)
        if len(stored) >= len(raw):
            coder, stored = Coder.RAW, raw
        return Section(prop, index, coder, planes, zlib.crc32(stored), len(raw), len(stored)), stored


def context_section(prop: Property, index: int, streams: int, integers: int, stored: bytes) -> tuple[Section, bytes]:
    """A section of coder CONTEXT from its stored bytes."""
    return Section(prop, index, Coder.CONTEXT, streams, zlib.crc32(stored), integers, len(stored)), stored


def stored_bytes(data: bytes | memoryview, section: Section) -> memoryview:
    """A section's bytes as they are stored.

    Raises:
        DataError: they are damaged.
    """
    stored = memoryview(data)[section.offset : section.offset + section.stored_bytes]
    if len(stored) != section.stored_bytes or zlib.crc32(stored) != section.crc:
        raise DataError(f"section '{section.name}' is damaged (its checksum does not match): get the file again")
    return stored


def read_section(data: bytes | memoryview, section: Section) -> NDArray[np.uint8]:
    """A section's bytes before coding, for every coder but CONTEXT: (raw_bytes,) uint8.

    Raises:
        DataError: the stored bytes are damaged.
    """
    stored = stored_bytes(data, section)
    raw: bytes | memoryview
    try:
        if section.coder == Coder.RAW:
            raw = stored
        elif section.coder == Coder.ZSTD:
            if zstandard.get_frame_parameters(stored).content_size != section.raw_bytes:
                raise DataError(f"section '{section.name}' decompresses to another size than the header says")
            raw = zstandard.ZstdDecompressor().decompress(stored, allow_extra_data=False)
        else:
            inflater = zlib.decompressobj()
            raw = inflater.decompress(stored, section.raw_bytes + 1)
            if not inflater.eof or inflater.unused_data:
                raise DataError(f"section '{section.name}' does not end where the header says")
    except (zstandard.ZstdError, zlib.error) as error:
        raise DataError(f"section '{section.name}' does not decompress: {error}") from None
    if len(raw) != section.raw_bytes:
        raise DataError(f"section '{section.name}' decompresses to another size than the header says")
    return np.frombuffer(raw, np.uint8)


# ------------------------------------------------------------------------------------------------ container


def assemble(header: Header, coded: list[tuple[Section, bytes]]) -> list[bytes]:
    """The pieces of a file, in order: header with the table of the coded sections, then each section's bytes."""
    header_bytes = _FIXED.size + _ENTRY.size * len(coded) + _CRC.size
    file_bytes = header_bytes + sum(len(stored) for _, stored in coded)
    fixed = _FIXED.pack(
        MAGIC,
        header.version,
        0,
        header_bytes,
        file_bytes,
        header.splats,
        header.sh_degree,
        header.depth,
        len(coded),
        0,
        *header.origin,
        header.side,
        header.sf_scale,
        header.sf_rotation,
        header.sf_opacity,
        header.sf_dc,
        bytes(8) if header.version == 1 else _FACTOR.pack(header.sf_ac),
        bytes(8),
    )
    table = b"".join(
        _ENTRY.pack(s.kind, s.index, s.coder, s.planes, s.crc, s.raw_bytes, s.stored_bytes) for s, _ in coded
    )
    return [fixed + table + _CRC.pack(zlib.crc32(fixed + table)), *(stored for _, stored in coded)]


def read_header(data: bytes | memoryview, file_bytes: int) -> Header:
    """Parse and verify header and section table.

    Args:
        data: the first bytes of the file, all of the header at least.
        file_bytes: real size of the file.

    Raises:
        DataError: not a .potr file, a future version, damaged, truncated, or sizes that cannot be true.
    """
    start = bytes(data[: len(MAGIC)])
    if file_bytes == 0:
        raise DataError("the file is empty")
    if start != MAGIC:
        if start[:4] == MAGIC[:4]:
            raise DataError("the file was changed in transfer (line ends were converted): copy it again as binary")
        raise DataError("not a .potr file (its first bytes are not 'POTR')")
    if len(data) < _FIXED.size:
        raise DataError(f"truncated: {file_bytes} bytes do not even hold the header")
    version = int.from_bytes(data[8:10], "little")
    if version > VERSION:
        raise DataError(f"format version {version}, this potr_cl reads up to {VERSION}: update potr_cl")
    fields = _FIXED.unpack_from(data)
    _, _, flags, header_bytes, said_bytes, splats, degree, depth, count, reserved = fields[:10]
    numbers = fields[10:18]
    wanted = _FIXED.size + _ENTRY.size * count + _CRC.size
    if header_bytes != wanted:
        raise DataError("the header is damaged (its size does not fit its number of sections): get the file again")
    if len(data) < header_bytes:
        raise DataError(f"truncated: the header has {header_bytes} bytes, the file {file_bytes}")
    if zlib.crc32(data[: header_bytes - _CRC.size]) != _CRC.unpack_from(data, header_bytes - _CRC.size)[0]:
        raise DataError("the header is damaged (its checksum does not match): get the file again")
    if said_bytes != file_bytes:
        how = "truncated" if file_bytes < said_bytes else "followed by something else"
        raise DataError(f"{how}: the file has {file_bytes} bytes, its header says {said_bytes}")
    if version == 1:
        sf_ac = numbers[7]
        reserved = reserved or any(fields[18])
    else:
        (sf_ac,) = _FACTOR.unpack(fields[18])
    if version < 1 or flags or reserved or any(fields[19]):
        raise DataError(f"format version {version} with flags {flags} is unknown")
    if degree >= len(SH_COEFFICIENTS) or splats < 1 or depth > 52:
        raise DataError(f"the header makes no sense: {splats} splats, SH degree {degree}, octree of {depth} levels")
    if not all(math.isfinite(x) and abs(x) < 1e38 for x in numbers) or numbers[3] < 0:
        raise DataError("the header makes no sense: its root cube is not finite")
    if not all(1e-3 <= x <= 1e9 for x in (*numbers[4:], sf_ac)):
        raise DataError("the header makes no sense: a scale factor outside 0.001 to 1e9")
    sections = _read_table(data, count, header_bytes, file_bytes, version, splats, degree)
    origin, side = (numbers[0], numbers[1], numbers[2]), numbers[3]
    sf_scale, sf_rotation, sf_opacity, sf_dc = numbers[4:8]
    return Header(
        version, splats, degree, origin, side, depth, sf_scale, sf_rotation, sf_opacity, sf_dc, sf_ac, sections
    )


def _read_table(
    data: bytes | memoryview, count: int, offset: int, file_bytes: int, version: int, splats: int, degree: int
) -> tuple[Section, ...]:
    sections: list[Section] = []
    seen: set[tuple[int, int]] = set()
    for i in range(count):
        prop, index, coder, planes, crc, raw_bytes, stored_bytes = _ENTRY.unpack_from(
            data, _FIXED.size + i * _ENTRY.size
        )
        try:
            section = Section(Property(prop), index, Coder(coder), planes, crc, raw_bytes, stored_bytes, offset)
        except ValueError:
            raise DataError(f"section {i} has an unknown kind ({prop}) or coder ({coder}): update potr_cl") from None
        what = f"section '{section.name}'"
        indices = range(index, index + (planes if coder == Coder.CONTEXT else 1))
        if index >= _INDICES[section.kind] or any((prop, i) in seen for i in indices):
            raise DataError(f"{what} has an impossible index or stands twice")
        if section.kind == Property.SH and index >= 3 * SH_COEFFICIENTS[degree]:
            raise DataError(f"{what} does not belong to SH degree {degree}")
        if coder == Coder.CONTEXT:
            possible = version >= 2 and (index, planes) in context_groups(section.kind, degree)
            if not possible:
                raise DataError(f"{what} cannot hold {planes} streams of coder {coder}")
        elif not 1 <= planes <= 8:
            raise DataError(f"{what} holds integers of {planes} bytes")
        if raw_bytes % planes or (section.kind in _A_SPLAT and raw_bytes != planes * splats):
            raise DataError(
                f"{what} holds {raw_bytes} bytes, which does not fit {splats} splats of {planes} bytes each"
            )
        if stored_bytes > file_bytes - offset:
            raise DataError(f"{what} reaches beyond the end of the file")
        if raw_bytes > stored_bytes * _MOST_EXPANSION[section.coder]:
            raise DataError(f"{what} claims {raw_bytes} bytes, more than its {stored_bytes} stored bytes can hold")
        if section.kind == Property.METADATA and raw_bytes > MAX_METADATA:
            raise DataError(f"{what} is longer than {MAX_METADATA} bytes")
        seen.update((prop, i) for i in indices)
        sections.append(section)
        offset += stored_bytes
    if offset != file_bytes:
        raise DataError("the sections do not fill the file")
    if (Property.OPACITY, 0) not in seen:
        raise DataError("there is no opacity section")
    return tuple(sections)


def indices(prop: Property) -> int:
    """Number of streams that a property can have."""
    return _INDICES[prop]


def is_predicted(prop: Property, index: int) -> bool:
    """Whether coder CONTEXT stores a property's differences from the splats before."""
    return prop == Property.SH and index == 0


def is_signed(prop: Property) -> bool:
    """Whether a property's integers are zig-zag mapped."""
    return prop in _SIGNED
