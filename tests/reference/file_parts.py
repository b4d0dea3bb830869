"""A .potr file in parts that can be changed one by one (:class:`File`), for tests and for those who look for faults.

The layout is that of docs/format.md and is written out here anew, so that a mistake in the package's own is not shared.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib

_HEADER = struct.Struct("<8sHBBIQIBBH")
_BLOCK = struct.Struct("<BBBBI10fd5f")
_ENTRY = struct.Struct("<4sIII")
_CRC = struct.Struct("<I")
#: Streams of the sections of splats, in the order of the format.
STREAMS = {b"OPAC": 1, b"SCAL": 3, b"ROTA": 3, b"SHC0": 3, b"SHC1": 9, b"SHC2": 15, b"SHC3": 21}


@dataclasses.dataclass
class Section:
    """A table entry and what belongs to it; ``crc`` and ``size`` replace the right ones."""

    name: bytes
    stored: bytes
    raw: int
    crc: int | None = None
    size: int | None = None

    def entry(self) -> bytes:
        size = len(self.stored) if self.size is None else self.size
        return _ENTRY.pack(self.name, size, self.raw, zlib.crc32(self.stored) if self.crc is None else self.crc)


@dataclasses.dataclass
class Block:
    """A block: ``reals`` are its box, the origin, and its error; ``count`` replaces the number of its sections."""

    level: int
    coder: int
    depth: int
    splats: int
    reals: list[float]
    side: float
    factors: list[float]
    sections: list[Section]
    count: int | None = None


@dataclasses.dataclass
class File:
    """A .potr file in parts that can be changed one by one; :meth:`bytes` makes sizes and checksums right again."""

    magic: bytes
    version: int
    flags: int
    degree: int
    quantiser: int
    reserved: int
    sections: list[Section]
    blocks: list[Block]
    count: int | None = None

    @staticmethod
    def of(data: bytes) -> File:
        magic, version, flags, degree, start, _, count, quantiser, own, reserved = _HEADER.unpack_from(data)
        at = _HEADER.size

        def sections(number: int) -> list[Section]:
            nonlocal at, start
            found = []
            for _ in range(number):
                name, stored, raw, _ = _ENTRY.unpack_from(data, at)
                found.append(Section(name, data[start : start + stored], raw))
                at, start = at + _ENTRY.size, start + stored
            return found

        of_file, blocks = sections(own), []
        for _ in range(count):
            level, coder, depth, number, splats, *reals = _BLOCK.unpack_from(data, at)
            at += _BLOCK.size
            blocks.append(Block(level, coder, depth, splats, reals[:10], reals[10], reals[11:], sections(number)))
        return File(magic, version, flags, degree, quantiser, reserved, of_file, blocks)

    def bytes(self) -> bytes:
        table = b"".join(section.entry() for section in self.sections)
        for b in self.blocks:
            count = len(b.sections) if b.count is None else b.count
            table += _BLOCK.pack(b.level, b.coder, b.depth, count, b.splats, *b.reals, b.side, *b.factors)
            table += b"".join(section.entry() for section in b.sections)
        body = b"".join(s.stored for own in (self.sections, *(b.sections for b in self.blocks)) for s in own)
        size = _HEADER.size + len(table) + _CRC.size
        head = _HEADER.pack(
            self.magic, self.version, self.flags, self.degree, size, size + len(body),
            len(self.blocks) if self.count is None else self.count, self.quantiser, len(self.sections), self.reserved,
        )  # fmt: skip
        head += table
        return head + _CRC.pack(zlib.crc32(head)) + body

    def all_sections(self) -> list[tuple[Block | None, Section]]:
        """Each with its block; None: it is the file's own."""
        return [(None, s) for s in self.sections] + [(b, s) for b in self.blocks for s in b.sections]


def sealed(data: bytes) -> bytes:
    """A file with checksums made right for whatever its header and its table say now."""
    try:
        return File.of(data).bytes()
    except (struct.error, OverflowError):  # too short
        return data
