"""Changed .potr files of blocks: header and table, and the blocks themselves, mostly with checksums made right.

As in :mod:`tools.stress.hostile.potr_files` the layout is written out here anew.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib
from functools import cache
from random import Random

from potr_cl.codec.blocks.encoder import code_blocks
from potr_cl.codec.blocks.geometry import GeometryOfBlocks, quantise
from potr_cl.codec.blocks.splitting import blocks_of
from potr_cl.codec.quantize import HyperParameters
from tests.reference.scenes import random_scene
from tools.stress.hostile import potr_files
from tools.stress.hostile.changes import damaged, damaged_json, interesting

_HEADER = struct.Struct("<8sHHIQQB3sIII")
_ENTRY = struct.Struct("<6fQQII")
_CRC = struct.Struct("<I")


@dataclasses.dataclass
class Block:
    """A table entry and its bytes; ``nbytes`` and ``crc`` replace the right ones."""

    box: tuple[float, ...]
    splats: int
    stored: bytes
    nbytes: int | None = None
    crc: int | None = None
    zero: int = 0


@dataclasses.dataclass
class File:
    """A file of blocks in parts that can be changed one by one; :meth:`bytes` makes sizes and checksums right again."""

    version: int
    flags: int
    splats: int
    degree: int
    zeros: bytes
    reserved: int
    metadata: bytes
    blocks: list[Block]
    count: int | None = None

    @staticmethod
    def of(data: bytes) -> File:
        _, version, flags, start, _, splats, degree, zeros, count, metadata_bytes, reserved = _HEADER.unpack_from(data)
        blocks, end = [], _HEADER.size + _ENTRY.size * count
        metadata = data[end : end + metadata_bytes]
        for i in range(count):
            *box, own, nbytes, _, zero = _ENTRY.unpack_from(data, _HEADER.size + i * _ENTRY.size)
            blocks.append(Block(tuple(box), own, data[start : start + nbytes], zero=zero))
            start += nbytes
        return File(version, flags, splats, degree, zeros, reserved, metadata, blocks)

    def bytes(self) -> bytes:
        start = _HEADER.size + _ENTRY.size * len(self.blocks) + len(self.metadata) + _CRC.size
        head = _HEADER.pack(
            potr_files.originals()[0][:8], self.version, self.flags, start,
            start + sum(len(block.stored) for block in self.blocks), self.splats, self.degree, self.zeros,
            len(self.blocks) if self.count is None else self.count, len(self.metadata), self.reserved,
        )  # fmt: skip
        for block in self.blocks:
            nbytes = len(block.stored) if block.nbytes is None else block.nbytes
            crc = zlib.crc32(block.stored) if block.crc is None else block.crc
            head += _ENTRY.pack(*block.box, block.splats, nbytes, crc, block.zero)
        head += self.metadata
        return head + _CRC.pack(zlib.crc32(head)) + b"".join(block.stored for block in self.blocks)


@cache
def originals() -> list[bytes]:
    """Good files of one to five blocks."""
    files = []
    for number, (splats, degree, most) in enumerate([(12, 1, 5), (1, 0, 1), (40, 0, 8), (20, 3, 20)]):
        scene = random_scene(splats, degree, seed=50 + number)
        geometry = quantise(scene, HyperParameters.from_quality(0.5, "best"), [], rows=blocks_of(scene.means, most))
        assert isinstance(geometry, GeometryOfBlocks)
        files.append(b"".join(code_blocks(scene, geometry, b'{"q": 0.5}').pieces))
    return files


def changed(rng: Random) -> bytes:
    """One of the originals, changed."""
    data = rng.choice(originals())
    if rng.random() < 0.15:  # as it comes, checksums and all
        return damaged(data, rng)
    file = File.of(data)
    for _ in range(1 + rng.choice((0, 0, 1))):
        rng.choice(_CHANGES)(file, rng)
    try:
        return file.bytes()
    except (struct.error, OverflowError):  # a field took a number that it cannot hold
        return damaged(data, rng)


def _header(file: File, rng: Random) -> None:
    kind = rng.randrange(7)
    if kind == 0:
        file.version = rng.choice((0, 1, 2, 3, 4, 5, interesting(rng, 2)))
    elif kind == 1:
        file.splats = rng.choice((interesting(rng, 8), interesting(rng, 2), file.splats + 1, file.splats - 1))
    elif kind == 2:
        file.degree = rng.choice((0, 1, 2, 3, 4, interesting(rng, 1)))
    elif kind == 3:
        file.flags, file.zeros, file.reserved = rng.choice((0, 1, 2, 3)), rng.choice((bytes(3), b"\1\0\0")), 0
    elif kind == 4:
        file.reserved = interesting(rng, 4)
    elif kind == 5:
        file.count = rng.choice((0, len(file.blocks) + 1, interesting(rng, 4)))
    else:
        file.metadata = damaged_json(file.metadata, rng)


def _table(file: File, rng: Random) -> None:
    if not file.blocks:
        return
    block = rng.choice(file.blocks)
    kind = rng.randrange(6)
    if kind == 0:
        corners = list(block.box)
        corners[rng.randrange(6)] = rng.choice((float("nan"), float("inf"), -1e38, 0.0, 1e38))
        block.box = tuple(corners)
    elif kind == 1:
        block.splats = rng.choice((interesting(rng, 8), block.splats + 1, block.splats - 1, 0))
    elif kind == 2:
        block.nbytes = rng.choice((interesting(rng, 8), len(block.stored) + 1, len(block.stored) - 1, 0))
    elif kind == 3:
        block.crc = interesting(rng, 4)
    elif kind == 4:
        block.zero = interesting(rng, 4)
    else:
        more = rng.randrange(1, 5)
        block.splats += more
        file.splats += more


def _order(file: File, rng: Random) -> None:
    """Blocks that lack, stand twice, change places, or are files of another version."""
    kind = rng.randrange(5)
    at = rng.randrange(len(file.blocks)) if file.blocks else 0
    if kind == 0 and file.blocks:
        file.splats -= file.blocks.pop(at).splats
    elif kind == 1 and file.blocks:
        file.blocks.append(dataclasses.replace(file.blocks[at]))
        file.splats += file.blocks[at].splats
    elif kind == 2:
        rng.shuffle(file.blocks)
    elif file.blocks:
        other = rng.choice(originals() if kind == 3 else potr_files.originals())
        splats = int.from_bytes(other[24:32], "little")
        file.splats += splats - file.blocks[at].splats
        file.blocks[at] = Block((-1e9,) * 3 + (1e9,) * 3, splats, other)


def _within(file: File, rng: Random) -> None:
    """A block that is changed as a file by itself."""
    if not file.blocks:
        return
    block = rng.choice(file.blocks)
    block.stored = damaged(block.stored, rng)
    if rng.random() < 0.7:
        block.stored = potr_files.sealed(block.stored)
    if rng.random() < 0.3:
        claimed = interesting(rng, rng.randrange(1, 6))
        file.splats += claimed - block.splats
        block.splats = claimed


_CHANGES = (_header, _table, _table, _order, _order, _within, _within, _within)
