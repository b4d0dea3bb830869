"""Changed SPZ files of versions 1 to 4: header, directory, streams, and what is inside gzip and Zstandard."""

from __future__ import annotations

import gzip
import struct
import zlib
from random import Random

import zstandard

from tools.stress.hostile.changes import damaged, interesting

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_EXTENSIONS = 2


def sections(version: int, splats: int, degree: int, rng: Random) -> list[bytes]:
    """The content of positions, opacities, colours, scales, rotations and SH, random."""
    sizes = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1))
    return [rng.randbytes(size * splats) for size in sizes]


def legacy(version: int, splats: int, degree: int, content: bytes, bits: int = 12, flags: int = 0) -> bytes:
    """What versions 1 to 3 put into gzip."""
    return _HEADER.pack(_MAGIC, version, splats, degree, bits, flags, 0) + content


def streamed(splats: int, degree: int, streams: list[bytes], raw_sizes: list[int], flags: int = 0) -> bytes:
    """A file of version 4 from its Zstandard streams."""
    start = _HEADER.pack(_MAGIC, 4, splats, degree, 12, flags, len(streams)) + struct.pack("<I", 32) + bytes(12)
    directory = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, raw_sizes, strict=True))
    return start + directory + b"".join(streams)


def originals() -> list[bytes]:
    """Good files of every version and SH degree."""
    files, rng = [], Random(0)
    for version in (1, 2, 3, 4):
        for degree in range(5):
            parts = [part for part in sections(version, 3, degree, rng) if part]
            if version < 4:
                files.append(gzip.compress(legacy(version, 3, degree, b"".join(parts)), mtime=0))
            else:
                streams = [zstandard.ZstdCompressor().compress(part) for part in parts]
                files.append(streamed(3, degree, streams, [len(part) for part in parts]))
    return files


def changed(rng: Random) -> bytes:
    """A small file of a random version, changed."""
    version = rng.choice((1, 2, 3, 4))
    splats, degree = rng.choice((1, 3, 20)), rng.randrange(5)
    parts = sections(version, splats, degree, rng)
    if version == 4:
        return _changed_streams(splats, degree, [part for part in parts if part], rng)
    return _changed_gzip(version, splats, degree, b"".join(parts), rng)


def _header_fields(version: int, splats: int, degree: int, streams: int, rng: Random) -> bytes:
    fields = [version, splats, degree, 12, rng.choice((0, 0, 1, 2, 3)), streams]
    for _ in range(rng.choice((0, 1, 1, 2))):
        at = rng.randrange(6)
        size = 4 if at < 2 else 1
        fields[at] = rng.choice((interesting(rng, size), min(fields[at] + 1, 255), max(fields[at] - 1, 0)))
    magic = _MAGIC if rng.random() < 0.97 else rng.randbytes(4)
    return _HEADER.pack(magic, *fields)


def _changed_gzip(version: int, splats: int, degree: int, content: bytes, rng: Random) -> bytes:
    raw = _header_fields(version, splats, degree, 0, rng) + content
    if rng.random() < 0.5:
        raw = damaged(raw, rng)
    if rng.random() < 0.2:
        raw += rng.choice((bytes(100), rng.randbytes(5), bytes(1 << 16)))
    kind = rng.randrange(10)
    if kind == 0:
        return raw  # not packed at all
    packed = gzip.compress(raw, rng.choice((0, 1, 9)), mtime=0)
    if kind == 1:  # several members, one after another
        half = rng.randrange(len(raw) + 1)
        packed = gzip.compress(raw[:half], 1, mtime=0) + gzip.compress(raw[half:], 1, mtime=0)
    elif kind == 2:  # a name, a comment and more in gzip's own header
        packed = b"\x1f\x8b\x08\x1c" + bytes(6) + b"\3\0abc" + b"\x1b[2Jname\0comment\0" + packed[10:]
    elif kind == 3:
        packed += rng.choice((b"\0" * 10, rng.randbytes(9), packed, b"\x1f\x8b"))
    elif kind == 4:  # the sums at the end say something else
        packed = packed[:-8] + struct.pack("<II", zlib.crc32(raw), interesting(rng, 4))
    elif kind == 5:
        packed = damaged(packed, rng)
    return packed


def _changed_streams(splats: int, degree: int, raw: list[bytes], rng: Random) -> bytes:
    streams = []
    for part in raw:
        odd = rng.random()
        if odd < 0.08:
            part = damaged(part, rng)
        elif odd < 0.1:
            part += bytes(1 << 16)
        packer = zstandard.ZstdCompressor(level=1, write_content_size=rng.random() < 0.9)
        stored = packer.compress(part)
        streams.append(damaged(stored, rng) if rng.random() < 0.06 else stored)
    entries = [[len(stream), len(part)] for stream, part in zip(streams, raw, strict=True)]
    directory_at = 32
    kind = rng.randrange(6)
    if kind == 0:
        entries[rng.randrange(len(entries))][rng.randrange(2)] = interesting(rng, rng.choice((1, 4, 8)))
    elif kind == 1:
        directory_at = rng.choice((0, 16, 31, 33, interesting(rng, 4)))
    elif kind == 2:
        at = rng.randrange(len(streams))
        streams[at], streams[0] = streams[0], streams[at]
    elif kind == 3:
        entries.append([0, 0])
    out = _header_fields(4, splats, degree, len(entries), rng) + struct.pack("<I", directory_at)
    out += rng.randbytes(12) if rng.random() < 0.1 else bytes(12)
    out += b"".join(struct.pack("<QQ", *entry) for entry in entries) + b"".join(streams)
    return damaged(out, rng) if rng.random() < 0.15 else out
