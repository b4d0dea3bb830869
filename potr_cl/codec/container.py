"""The .potr container: :func:`assemble` makes a file of coded sections, :func:`read_header` verifies header and table.

Knows bytes and integers only. docs/format.md is the normative description.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec.quantisers import QUANTISERS, Quantiser
from potr_cl.codec.sections import ORDER, Coder, Property, Section
from potr_cl.codec.steps.rule import MOST_BESIDE_GROUPS
from potr_cl.errors import DataError, UsageError
from potr_cl.host.inputs import FREE_SPLATS, check_claim
from potr_cl.model.box import Box
from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, SH_COEFFICIENTS

MAGIC = b"POTR\r\n\x1a\n"
VERSION = 1
#: Longest metadata that a reader accepts, bytes.
MAX_METADATA = 1 << 16
#: A block holds no more splats, and has no more sections; it lies no deeper.
MOST_SPLATS, MOST_SECTIONS, MOST_LEVELS = 1 << 22, 32, 52
#: There are no more blocks than the first number and one for each so many splats: each costs time of its own.
FREE_BLOCKS, SPLATS_A_BLOCK = 16, 1 << 14
#: Bytes of an integer of the plain coder, at most.
MOST_PLANES = 7
#: A splat, and a crowded cell of the octree, takes a bit of a file at least; what packs more is no scene.
MOST_A_BYTE = 8
#: A zstd frame claims no more for each byte: beyond is a lie, found before memory is taken.
_MOST_EXPANSION = 1 << 15

_FIXED = struct.Struct("<8sHBBIQIBBH")
_BLOCK = struct.Struct("<BBBBI6f3ffd5f")
_ENTRY = struct.Struct("<4sIII")
_CRC = struct.Struct("<I")
#: Bytes that tell how long the header is.
FIXED_BYTES = _FIXED.size
_NAME = re.compile(rb"[A-Za-z][A-Za-z0-9]{3}")
_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)

#: Bits of the header's flags. A reader that does not know one refuses the file: it would show another picture.
_ANTIALIASED, _MIP_SPLATTING = 1, 2
FLAGS = {
    (False, LOW_PASS): 0,
    (True, LOW_PASS): _ANTIALIASED,
    (True, MIP_SPLATTING_LOW_PASS): _ANTIALIASED | _MIP_SPLATTING,
}
OF_FLAGS = {flags: kind for kind, flags in FLAGS.items()}


@dataclass(frozen=True)
class Block:
    """All that a file says of a block outside its sections, and what it says of all blocks.

    Attributes:
        splats: number of splats, 1 to :data:`MOST_SPLATS`.
        sh_degree: 0 to 3.
        origin, side, depth: root cube and deepest level of the octree (:class:`potr_cl.codec.octree.OctreeStreams`).
        sf_scale, sf_rotation, sf_opacity, sf_dc, sf_ac: scale factors, single precision numbers.
        quantiser: number of the quantiser (:data:`potr_cl.codec.quantisers.QUANTISERS`).
        coder: of the splats' integers.
        box: in which all centres lie.
        level: of detail; 0 is the finest.
        error: by how far, world units, its splats may be off those of level 0.
        antialiased, low_pass: how the scene is to be rendered (:class:`potr_cl.model.scene.Scene`).
        sections: in the order of their bytes.
        first: the number of its first splat among those of its level.
        offset: of its first byte in the file.
    """

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
    quantiser: int
    coder: Coder
    box: Box
    level: int = 0
    error: float = 0.0
    antialiased: bool = False
    low_pass: float = LOW_PASS
    sections: tuple[Section, ...] = ()
    first: int = 0
    offset: int = 0

    def find(self, prop: Property) -> Section | None:
        """The section of a property, None where the block has none (all of its integers are 0)."""
        return self._by_kind.get(prop)

    @cached_property
    def _by_kind(self) -> dict[Property, Section]:
        return {section.kind: section for section in self.sections if section.kind}

    @property
    def rules(self) -> Quantiser:
        """Of its values."""
        return QUANTISERS[self.quantiser]

    @property
    def nbytes(self) -> int:
        """Of all sections together."""
        return sum(section.stored_bytes for section in self.sections)

    def bytes_to(self, degree: int) -> int:
        """Of those that stand before the first of SH coefficients of a higher degree."""
        degrees = ((s.offset, s.kind.degree) for s in self.sections if s.kind is not None)
        return min((at for at, own in degrees if own is not None and own > degree), default=self.nbytes)


@dataclass(frozen=True)
class FileHeader:
    """All that a file says outside its sections.

    Attributes:
        blocks: level by level, the finest last.
        sections: of the file itself, which stand before all blocks.
        start: offset of the first of them: the header's size.
        file_bytes: size of the whole file.
    """

    blocks: tuple[Block, ...]
    sections: tuple[Section, ...] = ()
    start: int = 0
    file_bytes: int = 0

    def of_level(self, level: int = 0) -> list[int]:
        """The numbers of a level's blocks."""
        return [number for number, block in enumerate(self.blocks) if block.level == level]

    @property
    def splats(self) -> int:
        """Of the finest level."""
        return sum(block.splats for block in self.blocks if block.level == 0)

    @property
    def sh_degree(self) -> int:
        return self.blocks[0].sh_degree


# ------------------------------------------------------------------------------------------------ sections

ENTROPY_CODERS = ("bundles", "zstd")


@dataclass(frozen=True)
class EntropyCoder:
    """The entropy stage: "bundles" (:mod:`potr_cl.codec.bundles`), or "zstd" for all (:mod:`potr_cl.codec.plain`).

    Attributes:
        name: of the coder of the splats' integers.
        level: of zstd, 1 to 22, for all that is coded by it.

    Raises:
        UsageError: unknown name or level.
    """

    name: str = "bundles"
    level: int = 19

    def __post_init__(self) -> None:
        if self.name not in ENTROPY_CODERS:
            raise UsageError(f"entropy coder '{self.name}' is unknown: choose one of {', '.join(ENTROPY_CODERS)}")
        if not 1 <= self.level <= 22:
            raise UsageError(f"zstd level {self.level} is unknown: choose 1 to 22")

    def section(self, prop: Property, raw: bytes) -> tuple[Section, bytes]:
        """A section's entry and stored bytes: a zstd frame, or the content as it is where that is no larger."""
        stored = zstandard.ZstdCompressor(level=self.level, write_checksum=False).compress(raw)
        return section_of(prop, raw, stored if len(stored) < len(raw) else raw)


def section_of(prop: Property, raw: bytes, stored: bytes) -> tuple[Section, bytes]:
    """A section's entry and stored bytes."""
    return Section(prop.value, len(stored), len(raw), zlib.crc32(stored)), stored


def unchecked_bytes(data: bytes | memoryview, section: Section) -> memoryview:
    """A section's bytes as they are stored, whatever their checksum."""
    return memoryview(data)[section.offset : section.offset + section.stored_bytes]


def is_sound(data: bytes | memoryview, section: Section) -> bool:
    """Whether a section's stored bytes are all there, and have its checksum."""
    stored = unchecked_bytes(data, section)
    return len(stored) == section.stored_bytes and zlib.crc32(stored) == section.crc


def stored_bytes(data: bytes | memoryview, section: Section) -> memoryview:
    """A section's bytes as they are stored. Raises DataError if they are damaged."""
    if not is_sound(data, section):
        raise DataError(f"section '{section.title}' is damaged (its checksum does not match): get the file again")
    return unchecked_bytes(data, section)


def read_section(data: bytes | memoryview, section: Section) -> NDArray[np.uint8]:
    """A section's content: (raw_bytes,) uint8. Raises DataError if the stored bytes are damaged."""
    stored, size = stored_bytes(data, section), section.raw_bytes
    return np.frombuffer(stored if len(stored) == size else inflated(stored, size, section.title), np.uint8)


def inflated(stored: bytes | memoryview, size: int, what: str) -> bytes:
    """The content of one zstd frame, of which nothing is trusted, which must have a size.

    Raises:
        DataError: damaged; ``what`` is the section, for the message.
    """
    try:
        if zstandard.get_frame_parameters(stored).content_size == size:
            raw = zstandard.ZstdDecompressor(max_window_size=1 << 31).decompress(stored, allow_extra_data=False)
            if len(raw) == size:
                return raw
    except zstandard.ZstdError as error:
        raise DataError(f"section '{what}' does not decompress: {error}") from None
    raise DataError(f"section '{what}' decompresses to another size than the header says")


# ------------------------------------------------------------------------------------------------ container

#: A section's entry and its stored bytes.
CodedSection = tuple[Section, bytes]


def assemble(blocks: Sequence[tuple[Block, Sequence[CodedSection]]], own: Sequence[CodedSection] = ()) -> list[bytes]:
    """The pieces of a file, in order: header with its table, the file's own sections, then each block's.

    Args:
        blocks: each and its sections, in their order. Levels never rise, and end at 0.
        own: the file's.
    """
    head = blocks[0][0]
    table = b"".join(_entries(own))
    for block, coded in blocks:
        box, factors = block.box, (block.sf_scale, block.sf_rotation, block.sf_opacity, block.sf_dc, block.sf_ac)
        table += _BLOCK.pack(
            block.level, block.coder, block.depth, len(coded), block.splats, *box.low, *box.high, *block.origin,
            block.error, block.side, *factors,
        )  # fmt: skip
        table += b"".join(_entries(coded))
    pieces = [stored for coded in (own, *(coded for _, coded in blocks)) for _, stored in coded]
    size = _FIXED.size + len(table) + _CRC.size
    flags = FLAGS[head.antialiased, head.low_pass]
    start = _FIXED.pack(
        MAGIC, VERSION, flags, head.sh_degree, size, size + sum(map(len, pieces)), len(blocks), head.quantiser,
        len(own), 0,
    )  # fmt: skip
    return [start + table + _CRC.pack(zlib.crc32(start + table)), *pieces]


def _entries(coded: Sequence[CodedSection]) -> list[bytes]:
    return [_ENTRY.pack(s.name.encode(), s.stored_bytes, s.raw_bytes, s.crc) for s, _ in coded]


def header_bytes_of(start: bytes) -> int:
    """How many bytes the header says it has, by the first :data:`FIXED_BYTES` of a file; 0 if it is no .potr file."""
    return int(_FIXED.unpack_from(start)[4]) if len(start) >= FIXED_BYTES and start.startswith(MAGIC) else 0


def read_header(data: bytes | memoryview, file_bytes: int, trust: bool = False) -> FileHeader:
    """Parse and verify header and table.

    What passes is no larger, once it is unpacked, than the number of splats and the octrees' depths allow, and these
    are in proportion to the file.

    Args:
        data: the first bytes of the file, all of the header at least.
        file_bytes: real size of the file.
        trust: whether there may be more splats or cells a byte than a real scene has.

    Raises:
        DataError: not a .potr file, a future version, damaged, truncated, or sizes that cannot be true.
    """
    _check_start(bytes(data[:FIXED_BYTES]), file_bytes)
    fields = _FIXED.unpack_from(data)
    _, version, flags, degree, size, said_bytes, count, quantiser, own, reserved = fields
    if version != VERSION:
        raise DataError(f"format version {version}, this potr_cl reads version {VERSION}: update potr_cl")
    if len(data) < size:
        raise DataError(f"truncated: the header has {size} bytes, the file {file_bytes}")
    if size < _FIXED.size + _CRC.size or zlib.crc32(data[: size - _CRC.size]) != _CRC.unpack_from(data, size - 4)[0]:
        raise DataError("the header is damaged (its checksum does not match): get the file again")
    if said_bytes != file_bytes:
        how = "truncated" if file_bytes < said_bytes else "followed by something else"
        raise DataError(f"{how}: the file has {file_bytes} bytes, its header says {said_bytes}")
    if flags not in OF_FLAGS or quantiser not in QUANTISERS or reserved:
        raise DataError(f"a file with flags {flags} and quantiser {quantiser} is unknown: update potr_cl")
    if degree >= len(SH_COEFFICIENTS) or count < 1 or own > MOST_SECTIONS:
        raise DataError(f"invalid header: {count} blocks, SH degree {degree}")
    if not trust:  # before a long table is looked at
        _check_number(count, FREE_SPLATS + MOST_A_BYTE * file_bytes, f"a file of {file_bytes} bytes")
    table = _Table(data, _FIXED.size, size - _CRC.size, size, file_bytes)
    sections = table.sections(own, (Property.METADATA,), "the file")
    if any(section.kind is Property.METADATA and section.raw_bytes > MAX_METADATA for section in sections):
        raise DataError(f"section 'metadata' is longer than {MAX_METADATA} bytes")
    alike = Block(
        1, degree, (0, 0, 0), 0, 0, 1, 1, 1, 1, 1, quantiser, Coder.PLAIN, Box((0, 0, 0), (0, 0, 0)), 0, 0.0,
        *OF_FLAGS[flags],
    )  # fmt: skip
    blocks: list[Block] = []
    for number in range(count):
        blocks.append(table.block(number, alike, blocks[-1] if blocks else None, trust))
    if blocks[-1].level or not table.at_end:
        raise DataError("the sections do not fill the file, or the table its place, or the finest level is not there")
    splats = sum(block.splats for block in blocks)
    _check_number(count, splats, f"{splats} splats")
    check_claim(splats, file_bytes, MOST_A_BYTE, trust)
    return FileHeader(tuple(blocks), sections, size, file_bytes)


def _check_start(start: bytes, file_bytes: int) -> None:
    if file_bytes == 0:
        raise DataError("the file is empty")
    if not start.startswith(MAGIC):
        if start[:4] == MAGIC[:4]:
            raise DataError("the file was changed in transfer (line ends were converted): copy it again as binary")
        raise DataError(
            "not a .potr file (its first bytes are not 'POTR'); scenes of other formats are read by convert"
        )
    if len(start) < _FIXED.size:
        raise DataError(f"truncated: {file_bytes} bytes do not even hold the header")


def _check_number(blocks: int, splats: int, what: str) -> None:
    if blocks > FREE_BLOCKS + splats // SPLATS_A_BLOCK:
        raise DataError(f"{blocks} blocks are too many for {what}")


class _Table:
    """The entries of header and blocks, one after another.

    Args:
        data: the header.
        at, end: where the table begins and ends in it.
        offset: of the first section in the file.
        file_bytes: size of the file.
    """

    def __init__(self, data: bytes | memoryview, at: int, end: int, offset: int, file_bytes: int) -> None:
        self._data, self._at, self._end, self._offset, self._file_bytes = data, at, end, offset, file_bytes

    @property
    def at_end(self) -> bool:
        """Whether the table has been read to its end, and its sections fill the file."""
        return self._at == self._end and self._offset == self._file_bytes

    def _next(self, form: struct.Struct) -> tuple[Any, ...]:
        if self._at + form.size > self._end:
            raise DataError("the header is damaged (its table is longer than it says): get the file again")
        self._at += form.size
        return form.unpack_from(self._data, self._at - form.size)

    def sections(self, count: int, known: Sequence[Property], where: str) -> tuple[Section, ...]:
        """The next entries; sections that are known stand in their order."""
        found: list[Section] = []
        start, place = self._offset, 0
        for _ in range(count):
            name, stored, raw, crc = self._next(_ENTRY)
            if not _NAME.fullmatch(name):
                raise DataError(f"{where} has a section with an invalid name: get the file again")
            section = Section(name.decode(), stored, raw, crc, self._offset - start)
            what = f"section '{section.title}'"
            if section.kind in known:
                if section.kind not in known[place:]:
                    raise DataError(f"{what} stands twice, or not in its place")
                place = known.index(section.kind) + 1
            elif section.required:
                raise DataError(f"{where} needs a section '{section.name}' that this potr_cl does not know: update it")
            if stored > self._file_bytes - self._offset:
                raise DataError(f"{what} reaches beyond the end of the file")
            if raw > stored * _MOST_EXPANSION:
                raise DataError(f"{what} claims a size of {raw}, more than its {stored} stored bytes can hold")
            self._offset += stored
            found.append(section)
        return tuple(found)

    def block(self, number: int, alike: Block, before: Block | None, trust: bool) -> Block:
        """The next block, with what is the same in all."""
        what = f"block {number}"
        level, coder, depth, count, splats, *reals = self._next(_BLOCK)
        corners, origin, (error, side), factors = reals[:6], reals[6:9], reals[9:11], reals[11:]
        if coder not in tuple(Coder) or (coder == Coder.BUNDLES and not alike.rules.colour_steps):
            raise DataError(f"{what} is of coder {coder}, which is unknown: update potr_cl")
        if not 1 <= splats <= MOST_SPLATS or depth > MOST_LEVELS or count > MOST_SECTIONS:
            raise DataError(f"{what} is invalid: {splats} splats, octree of {depth} levels, {count} sections")
        if not all(map(math.isfinite, corners)) or any(a > b for a, b in zip(corners, corners[3:], strict=False)):
            raise DataError(f"{what} is invalid: its box is {corners}")
        if not all(map(math.isfinite, origin)) or not 0 <= side <= 2 * _LARGEST_FLOAT32:
            raise DataError(f"{what} is invalid: its root cube is not finite")
        if not all(np.float32(1e-3) <= x <= 1e9 for x in factors):
            raise DataError(f"{what} is invalid: a scale factor outside 0.001 to 1e9")
        if not 0 <= error < math.inf or (before is not None and not 0 <= before.level - level <= 1):
            raise DataError(f"{what} is invalid: level {level}, error {error}")
        offset, known = self._offset, [prop for prop in ORDER if (prop.degree or 0) <= alike.sh_degree]
        sections = self.sections(count, known, what)
        first = before.first + before.splats if before is not None and before.level == level else 0
        block = replace(
            alike, splats=splats, depth=depth, origin=(origin[0], origin[1], origin[2]), side=side,
            box=Box((corners[0], corners[1], corners[2]), (corners[3], corners[4], corners[5])), level=level,
            coder=Coder(coder), error=error, sections=sections, first=first, offset=offset,
            **dict(zip(("sf_scale", "sf_rotation", "sf_opacity", "sf_dc", "sf_ac"), factors, strict=True)),
        )  # fmt: skip
        check_claim(splats, block.nbytes, MOST_A_BYTE, trust)
        _check_sizes(block, what)
        cells = block.find(Property.OCCUPANCY)
        if cells is not None:
            check_claim(cells.raw_bytes, block.nbytes, MOST_A_BYTE, trust, "octree cells")
        return block


def _check_sizes(block: Block, what: str) -> None:
    """Check that sections are no longer than their splats need, before they are unpacked.

    A level has at most as many cells with splats as there are splats. A crowded cell above the deepest level has a byte
    of occupancy; every cell but the root is such a cell, or a leaf, of which there are no more than splats.
    """
    splats, depth = block.splats, block.depth
    cells = block.find(Property.OCCUPANCY)
    most = {
        Property.OCCUPANCY: splats * depth,
        Property.SEVERAL: (splats + (cells.raw_bytes if cells else 0) + 7) // 8,
        Property.MULTIPLICITY: 4 * (splats // 2),
        Property.LEAF_LEVEL: splats,
        Property.TAIL: 3 * depth * ((splats + 7) // 8),
        Property.STEPS: MOST_BESIDE_GROUPS + splats if block.rules.colour_steps else 0,
    }
    for section in block.sections:
        kind = section.kind
        if kind is None:
            continue
        limit = most.get(kind, kind.streams * (1 + MOST_PLANES * splats))
        if kind.streams and block.coder == Coder.BUNDLES:
            limit = section.stored_bytes  # they are stored as they are
        if section.raw_bytes > limit:
            raise DataError(
                f"{what}: section '{kind.title}' holds {section.raw_bytes} bytes, more than {splats} splats in an "
                f"octree of {depth} levels can need"
            )
        if kind.streams and block.coder == Coder.BUNDLES and section.raw_bytes != section.stored_bytes:
            raise DataError(f"{what}: section '{kind.title}' is of bundles, and not stored as it is")
    if block.find(Property.OPACITY) is None:
        raise DataError(f"{what}: there is no opacity section")
