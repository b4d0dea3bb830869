"""The container of files of blocks: :func:`assemble` makes its header, :func:`read_table` verifies one.

docs/format.md is the normative description. What a block holds is the business of :mod:`potr_cl.codec.container`.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from potr_cl.codec import metadata
from potr_cl.codec.container import FLAGS, MAGIC, MAX_METADATA, MOST_A_BYTE, OF_FLAGS, VERSION_OF_BLOCKS
from potr_cl.codec.sound_header import CRC, require_sound_header
from potr_cl.errors import DataError
from potr_cl.model.box import Box
from potr_cl.model.claims import check_claim
from potr_cl.model.scene import LOW_PASS, SH_COEFFICIENTS

_FIXED = struct.Struct("<8sHHIQQB3sIII")
_ENTRY = struct.Struct("<6fQQII")
#: Each block takes time to open, whatever it holds: there are so many at most, and one more for so many splats.
_BLOCKS, _LEAST_A_BLOCK = 32, 1024
#: Bytes that tell how long the header is.
FIXED_BYTES = _FIXED.size


@dataclass(frozen=True)
class Block:
    """A line of the table.

    Attributes:
        box: in which all of the block's centres lie.
        splats: how many there are, >= 1.
        first: the number in the file of the first of them.
        offset, nbytes: where the block's bytes are in the file.
        crc: CRC-32 of these.
    """

    box: Box
    splats: int
    first: int
    offset: int
    nbytes: int
    crc: int


@dataclass(frozen=True)
class BlockTable:
    """All that a file of blocks says of itself outside of its blocks.

    Attributes:
        splats, sh_degree: of the whole scene.
        antialiased, low_pass: how it is to be rendered (:class:`potr_cl.model.scene.Scene`).
        metadata: as of a section of that name.
        blocks: in the order of their bytes.
        file_bytes: size of the whole file.
    """

    splats: int
    sh_degree: int
    antialiased: bool = False
    low_pass: float = LOW_PASS
    metadata: bytes = b""
    blocks: tuple[Block, ...] = ()
    file_bytes: int = 0


def header_bytes_of(start: bytes) -> int:
    """How many bytes the header has, by the first ones of the file; no more than those are looked at."""
    fields = _FIXED.unpack_from(start)
    return int(fields[3])


def is_of_blocks(start: bytes) -> bool:
    """Whether a file with these first bytes says that it is one of blocks."""
    return len(start) >= FIXED_BYTES and start.startswith(MAGIC) and _version(start) == VERSION_OF_BLOCKS


def _version(start: bytes) -> int:
    return int.from_bytes(start[8:10], "little")


def assemble(table: BlockTable, blocks: Sequence[tuple[Box, int, Sequence[bytes]]]) -> list[bytes]:
    """The pieces of a file, in order: the header, then those of the blocks.

    Args:
        table: its blocks and size are not looked at.
        blocks: of each its box, whose corners are single precision numbers, its splats, and its pieces.
    """
    sizes = [sum(map(len, pieces)) for _, _, pieces in blocks]
    header_bytes = _FIXED.size + _ENTRY.size * len(blocks) + len(table.metadata) + CRC.size
    head = _FIXED.pack(
        MAGIC,
        VERSION_OF_BLOCKS,
        FLAGS[table.antialiased, table.low_pass],
        header_bytes,
        header_bytes + sum(sizes),
        sum(splats for _, splats, _ in blocks),
        table.sh_degree,
        bytes(3),
        len(blocks),
        len(table.metadata),
        0,
    )
    for (box, splats, pieces), nbytes in zip(blocks, sizes, strict=True):
        crc = 0
        for piece in pieces:
            crc = zlib.crc32(piece, crc)
        head += _ENTRY.pack(*box.low, *box.high, splats, nbytes, crc, 0)
    head += table.metadata
    return [head + CRC.pack(zlib.crc32(head)), *(piece for _, _, pieces in blocks for piece in pieces)]


def read_table(data: bytes | memoryview, file_bytes: int, trust: bool = False) -> BlockTable:
    """Parse and verify the header of a file of blocks.

    Args:
        data: the first bytes of the file, all of the header at least.
        file_bytes: real size of the file.
        trust: whether there may be more splats a byte than a real scene has.

    Raises:
        DataError: damaged, truncated, or numbers that cannot be true.
    """
    fields = _FIXED.unpack_from(data)
    _, version, flags, header_bytes, said_bytes, splats, degree, zeros, count, metadata_bytes, reserved = fields
    counted = _FIXED.size + _ENTRY.size * count + metadata_bytes + CRC.size
    require_sound_header(data, header_bytes, counted, "blocks", said_bytes, file_bytes)
    if flags not in OF_FLAGS or any(zeros) or reserved:
        raise DataError(f"format version {version} with flags {flags} is unknown: update potr_cl")
    if degree >= len(SH_COEFFICIENTS) or count < 1 or metadata_bytes > MAX_METADATA:
        raise DataError(f"the header makes no sense: {count} blocks, SH degree {degree}")
    if count > _BLOCKS + splats // _LEAST_A_BLOCK:
        raise DataError(f"the header makes no sense: {count} blocks of {splats} splats")
    blocks, first, offset = [], 0, header_bytes
    for number in range(count):
        *corners, own, nbytes, crc, zero = _ENTRY.unpack_from(data, _FIXED.size + number * _ENTRY.size)
        low, high = (corners[0], corners[1], corners[2]), (corners[3], corners[4], corners[5])
        if not all(map(math.isfinite, corners)) or any(a > b for a, b in zip(low, high, strict=True)) or zero:
            raise DataError(f"block {number} makes no sense: its box is {corners}")
        if not 1 <= own <= splats - first or nbytes > file_bytes - offset:
            raise DataError(f"block {number} claims {own} splats in {nbytes} bytes, more than the file has")
        check_claim(own, nbytes, MOST_A_BYTE, trust)
        blocks.append(Block(Box(low, high), own, first, offset, nbytes, crc))
        first, offset = first + own, offset + nbytes
    if first != splats or offset != file_bytes:
        raise DataError("the blocks do not fill the file, or are not all of its splats")
    check_claim(splats, file_bytes, MOST_A_BYTE, trust)
    start = _FIXED.size + count * _ENTRY.size
    noted = bytes(data[start : start + metadata_bytes])
    metadata.parse(noted)  # it takes no part in the scene, but damage anywhere is damage
    return BlockTable(splats, degree, *OF_FLAGS[flags], noted, tuple(blocks), file_bytes)
