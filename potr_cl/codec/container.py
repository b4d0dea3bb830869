"""The .potr container: :func:`assemble` makes a file of coded sections, :func:`read_header` verifies one.

Header, section table, entropy coding of sections and checksums. Knows bytes and integers only: what the integers mean
is the business of a version of the format (:mod:`potr_cl.codec.versions`). docs/format.md is the normative description.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec.sections import Coder, Property, Section, context_groups, is_bytes, is_per_splat, stream_count
from potr_cl.codec.sound_header import CRC, require_sound_header
from potr_cl.codec.steps.rule import MOST_BESIDE_GROUPS
from potr_cl.codec.versions import VERSIONS, FormatVersion
from potr_cl.errors import DataError, UsageError
from potr_cl.model.claims import check_claim
from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, SH_COEFFICIENTS

MAGIC = b"POTR\r\n\x1a\n"
#: Longest metadata that a reader accepts, bytes.
MAX_METADATA = 1 << 16
#: Of files of blocks, each of which is a file of another version (:mod:`potr_cl.codec.blocks`).
VERSION_OF_BLOCKS = 4

_FIXED = struct.Struct("<8sHHIQQBBHI8d8s8s")
_FACTOR = struct.Struct("<d")
_ENTRY = struct.Struct("<BBBBIQQ")
#: Of a section in the table.
ENTRY_BYTES = _ENTRY.size

#: Bits of the header's flags. A reader that does not know one refuses the file: it would show another picture.
_ANTIALIASED, _MIP_SPLATTING = 1, 2
FLAGS = {
    (False, LOW_PASS): 0,
    (True, LOW_PASS): _ANTIALIASED,
    (True, MIP_SPLATTING_LOW_PASS): _ANTIALIASED | _MIP_SPLATTING,
}
OF_FLAGS = {flags: kind for kind, flags in FLAGS.items()}

#: A splat, and a crowded cell of the octree, takes a bit of a file at least; what packs more is no scene.
MOST_A_BYTE = 8
#: Beyond single precision no centre can be told.
_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)

#: The most that a coder's format can expand one stored byte to: a claim beyond is a lie, found before memory is taken.
_MOST_EXPANSION = {
    Coder.RAW: 1,
    Coder.ZSTD: 1 << 15,
    Coder.DEFLATE: 1032,
    Coder.CONTEXT: 1 << 15,
    Coder.BUNDLES: 1 << 16,
}


@dataclass(frozen=True)
class Header:
    """All that a file says of itself outside its sections.

    Attributes:
        splats: number of splats, >= 1.
        sh_degree: 0 to 3.
        origin, side, depth: root cube and deepest level of the octree (:class:`potr_cl.codec.octree.OctreeStreams`).
        sf_scale, sf_rotation, sf_opacity, sf_dc, sf_ac: scale factors; a version may have one for all of SH.
        sections: in the order of their bytes.
        antialiased, low_pass: how the scene is to be rendered (:class:`potr_cl.model.scene.Scene`).
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
    antialiased: bool = False
    low_pass: float = LOW_PASS

    def find(self, prop: Property, index: int = 0) -> Section | None:
        """The section of a property, None where the file has none (all of its integers are 0)."""
        return self._by_key.get((prop, index))

    @cached_property
    def _by_key(self) -> dict[tuple[Property, int], Section]:
        return {(section.kind, section.index): section for section in self.sections}


# ------------------------------------------------------------------------------------------------ entropy coding


ENTROPY_CODERS = ("context", "zstd", "npz")


@dataclass(frozen=True)
class EntropyCoder:
    """The entropy stage.

    "context": :mod:`potr_cl.codec.context` for all that there is one of a splat, zstd for the rest; versions of the
    format that do not have that coder take zstd. "zstd" at a level (1 to 22). "npz": deflate at zlib's default level,
    which is what .npz holds.

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
        """Code one stream: its integers as ``planes`` byte planes; stored as they are where no coding is smaller."""
        if self.name != "npz":
            coder, stored = Coder.ZSTD, zstandard.ZstdCompressor(level=self.level, write_checksum=False).compress(raw)
        else:
            coder, stored = Coder.DEFLATE, zlib.compress(raw)
        if len(stored) >= len(raw):
            coder, stored = Coder.RAW, raw
        return Section(prop, index, coder, zlib.crc32(stored), 1, len(raw) // planes, planes, len(stored)), stored


def stream_section(
    coder: Coder, prop: Property, index: int, streams: int, integers: int, stored: bytes
) -> tuple[Section, bytes]:
    """A section of a coder of streams from its stored bytes; ``integers`` of all streams together."""
    return Section(prop, index, coder, zlib.crc32(stored), streams, integers, 0, len(stored)), stored


def most_integers(coder: Coder, stored: bytes) -> int:
    """How many integers, or bytes, a section of so many stored bytes may hold."""
    return _MOST_EXPANSION[coder] * len(stored)


def unchecked_bytes(data: bytes | memoryview, section: Section) -> memoryview:
    """A section's bytes as they are stored, whatever their checksum."""
    return memoryview(data)[section.offset : section.offset + section.stored_bytes]


def is_sound(data: bytes | memoryview, section: Section) -> bool:
    """Whether a section's stored bytes are all there, and have its checksum."""
    stored = unchecked_bytes(data, section)
    return len(stored) == section.stored_bytes and zlib.crc32(stored) == section.crc


def stored_bytes(data: bytes | memoryview, section: Section) -> memoryview:
    """A section's bytes as they are stored.

    Raises:
        DataError: they are damaged.
    """
    if not is_sound(data, section):
        raise DataError(f"section '{section.name}' is damaged (its checksum does not match): get the file again")
    return unchecked_bytes(data, section)


def read_section(data: bytes | memoryview, section: Section) -> NDArray[np.uint8]:
    """A section's bytes before coding, for every coder but those of streams: (raw_bytes,) uint8.

    Raises:
        DataError: the stored bytes are damaged.
    """
    stored, size = stored_bytes(data, section), section.raw_bytes
    if size is None:
        raise DataError(f"section '{section.name}' holds what only another coder can read")
    raw: bytes | memoryview
    try:
        if section.coder == Coder.RAW:
            raw = stored
        elif section.coder == Coder.ZSTD:
            if zstandard.get_frame_parameters(stored).content_size != size:
                raise DataError(f"section '{section.name}' decompresses to another size than the header says")
            raw = zstandard.ZstdDecompressor().decompress(stored, allow_extra_data=False)
        else:
            inflater = zlib.decompressobj()
            raw = inflater.decompress(stored, size + 1)
            if not inflater.eof or inflater.unused_data:
                raise DataError(f"section '{section.name}' does not end where the header says")
    except (zstandard.ZstdError, zlib.error) as error:
        raise DataError(f"section '{section.name}' does not decompress: {error}") from None
    if len(raw) != size:
        raise DataError(f"section '{section.name}' decompresses to another size than the header says")
    return np.frombuffer(raw, np.uint8)


def raw_bytes(header: Header, data: bytes | memoryview, prop: Property, index: int = 0) -> NDArray[np.uint8]:
    """As :func:`read_section`, of the section of a property; empty where the file has none."""
    section = header.find(prop, index)
    return np.empty(0, np.uint8) if section is None else read_section(data, section)


# ------------------------------------------------------------------------------------------------ container


def assemble(header: Header, coded: list[tuple[Section, bytes]]) -> list[bytes]:
    """The pieces of a file, in order: header with the table of the coded sections, then each section's bytes."""
    header_bytes = _FIXED.size + _ENTRY.size * len(coded) + CRC.size
    file_bytes = header_bytes + sum(len(stored) for _, stored in coded)
    fixed = _FIXED.pack(
        MAGIC,
        header.version,
        FLAGS[header.antialiased, header.low_pass],
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
        _FACTOR.pack(header.sf_ac) if VERSIONS[header.version].separate_ac_factor else bytes(_FACTOR.size),
        bytes(8),
    )
    table = b"".join(_pack_entry(section) for section, _ in coded)
    return [fixed + table + CRC.pack(zlib.crc32(fixed + table)), *(stored for _, stored in coded)]


def read_header(data: bytes | memoryview, file_bytes: int, trust: bool = False) -> Header:
    """Parse and verify header and section table.

    What passes is no larger, once it is unpacked, than the number of splats and the octree's depth allow, and these are
    in proportion to the file.

    Args:
        data: the first bytes of the file, all of the header at least.
        file_bytes: real size of the file.
        trust: whether there may be more splats or cells a byte than a real scene has.

    Raises:
        DataError: not a .potr file, a future version, damaged, truncated, or sizes that cannot be true.
    """
    start = bytes(data[: len(MAGIC)])
    if file_bytes == 0:
        raise DataError("the file is empty")
    if start != MAGIC:
        if start[:4] == MAGIC[:4]:
            raise DataError("the file was changed in transfer (line ends were converted): copy it again as binary")
        raise DataError(
            "not a .potr file (its first bytes are not 'POTR'); scenes of other formats are read by convert"
        )
    if len(data) < _FIXED.size:
        raise DataError(f"truncated: {file_bytes} bytes do not even hold the header")
    version = int.from_bytes(data[8:10], "little")
    newest = max(*VERSIONS, VERSION_OF_BLOCKS)
    if version > newest:
        raise DataError(f"format version {version}, this potr_cl reads up to {newest}: update potr_cl")
    if version == VERSION_OF_BLOCKS:
        raise DataError("a file of blocks stands where one of another version must be")
    fields = _FIXED.unpack_from(data)
    _, _, flags, header_bytes, said_bytes, splats, degree, depth, count, reserved = fields[:10]
    numbers = fields[10:18]
    counted = _FIXED.size + _ENTRY.size * count + CRC.size
    require_sound_header(data, header_bytes, counted, "sections", said_bytes, file_bytes)
    rules = VERSIONS.get(version)
    if rules is not None and rules.separate_ac_factor:
        (sf_ac,) = _FACTOR.unpack(fields[18])
    else:
        sf_ac = numbers[7]
        reserved = reserved or any(fields[18])
    if rules is None or flags not in OF_FLAGS or reserved or any(fields[19]):
        raise DataError(f"format version {version} with flags {flags} is unknown: update potr_cl")
    if degree >= len(SH_COEFFICIENTS) or splats < 1 or depth > 52:
        raise DataError(f"the header makes no sense: {splats} splats, SH degree {degree}, octree of {depth} levels")
    if not all(abs(x) <= _LARGEST_FLOAT32 for x in numbers[:3]) or not 0 <= numbers[3] <= 2 * _LARGEST_FLOAT32:
        raise DataError("the header makes no sense: its root cube is not finite")
    if not all(1e-3 <= x <= 1e9 for x in (*numbers[4:], sf_ac)):
        raise DataError("the header makes no sense: a scale factor outside 0.001 to 1e9")
    sections = _read_table(data, count, header_bytes, file_bytes, rules, splats, degree)
    _check_sizes(sections, splats, depth)
    check_claim(splats, file_bytes, MOST_A_BYTE, trust)
    cells = sum(section.integers for section in sections if section.kind == Property.OCCUPANCY)
    check_claim(cells, file_bytes, MOST_A_BYTE, trust, "octree cells")
    origin, side = (numbers[0], numbers[1], numbers[2]), numbers[3]
    sf_scale, sf_rotation, sf_opacity, sf_dc = numbers[4:8]
    return Header(
        version, splats, degree, origin, side, depth, sf_scale, sf_rotation, sf_opacity, sf_dc, sf_ac, sections,
        *OF_FLAGS[flags],
    )  # fmt: skip


def _pack_entry(section: Section) -> bytes:
    """A table entry: one field is the number of streams or of planes, one that of integers or of bytes."""
    of_streams = section.coder.of_streams
    return _ENTRY.pack(
        section.kind,
        section.index,
        section.coder,
        section.streams if of_streams else section.planes,
        section.crc,
        section.integers if of_streams else section.planes * section.integers,
        section.stored_bytes,
    )


def _read_table(
    data: bytes | memoryview, count: int, offset: int, file_bytes: int, rules: FormatVersion, splats: int, degree: int
) -> tuple[Section, ...]:
    sections: list[Section] = []
    seen: set[tuple[int, int]] = set()
    for i in range(count):
        # As in _pack_entry: streams or planes, integers or bytes.
        prop, index, coder, number, crc, size, stored_bytes = _ENTRY.unpack_from(data, _FIXED.size + i * _ENTRY.size)
        of_streams = coder in (Coder.CONTEXT, Coder.BUNDLES)
        streams, planes = (number, 0) if of_streams else (1, number)
        integers = size if of_streams else size // max(planes, 1)
        try:
            section = Section(Property(prop), index, Coder(coder), crc, streams, integers, planes, stored_bytes, offset)
        except ValueError:
            raise DataError(f"section {i} has an unknown kind ({prop}) or coder ({coder}): update potr_cl") from None
        what = f"section '{section.name}'"
        if index >= stream_count(section.kind) or any((prop, k) in seen for k in section.indices):
            raise DataError(f"{what} has an impossible index or stands twice")
        if section.kind == Property.SH and index >= 3 * SH_COEFFICIENTS[degree]:
            raise DataError(f"{what} does not belong to SH degree {degree}")
        if section.kind == Property.STEPS and not rules.colour_steps:
            raise DataError(f"{what} does not belong to format version {rules.number}")
        if section.coder not in rules.coders:
            raise DataError(f"{what} is of coder {coder}, which format version {rules.number} does not have")
        if of_streams and (index, streams) not in context_groups(section.kind, degree):
            raise DataError(f"{what} cannot hold {streams} streams of coder {coder}")
        if not of_streams and not 1 <= planes <= (1 if is_bytes(section.kind) else 8):
            raise DataError(f"{what} holds integers of {planes} bytes")
        if size != integers * max(planes, 1) or (is_per_splat(section.kind) and integers != splats * streams):
            units = "integers" if of_streams else "bytes"
            raise DataError(f"{what} holds {size} {units}, which does not fit {splats} splats of {number} {units} each")
        if stored_bytes > file_bytes - offset:
            raise DataError(f"{what} reaches beyond the end of the file")
        if size > stored_bytes * _MOST_EXPANSION[section.coder]:
            raise DataError(f"{what} claims a size of {size}, more than its {stored_bytes} stored bytes can hold")
        if section.kind == Property.METADATA and size > MAX_METADATA:
            raise DataError(f"{what} is longer than {MAX_METADATA} bytes")
        seen.update((prop, k) for k in section.indices)
        sections.append(section)
        offset += stored_bytes
    if offset != file_bytes:
        raise DataError("the sections do not fill the file")
    if (Property.OPACITY, 0) not in seen:
        raise DataError("there is no opacity section")
    bundled = {section.coder == Coder.BUNDLES for section in sections if is_per_splat(section.kind)}
    if len(bundled) > 1:
        raise DataError(f"only some sections of splats are of coder {Coder.BUNDLES.value}")
    return tuple(sections)


def _check_sizes(sections: tuple[Section, ...], splats: int, depth: int) -> None:
    """Check that streams that are not one integer a splat are no longer than needed, before they are unpacked.

    A level has at most as many cells with splats as there are splats. A crowded cell above the deepest level has a byte
    of occupancy; every cell but the root is such a cell, or a leaf, of which there are no more than splats.
    """
    integers = {section.kind: section.integers for section in sections}
    most = {
        Property.OCCUPANCY: splats * depth,
        Property.SEVERAL: (splats + integers.get(Property.OCCUPANCY, 0) + 7) // 8,
        Property.MULTIPLICITY: splats // 2,
        Property.TAIL_LENGTH: splats,
        Property.TAIL: 3 * depth * ((splats + 7) // 8),
        Property.STEPS: MOST_BESIDE_GROUPS + splats,
    }
    for kind, limit in most.items():
        if integers.get(kind, 0) > limit:
            raise DataError(
                f"section '{kind.name.lower()}' holds {integers[kind]} integers, more than {splats} splats in an "
                f"octree of {depth} levels can need"
            )
