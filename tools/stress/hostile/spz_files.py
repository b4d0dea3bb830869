"""Changed SPZ files of versions 1 to 4, and gzipped scenes: headers, directory, streams, what is behind coders."""

from __future__ import annotations

import gzip
import struct
from random import Random

import zstandard

from tools.stress.hostile import ply_files
from tools.stress.hostile.changes import damaged, gzipped, with_number

_HEADER = struct.Struct("<4sIIBBBB")
#: Version, splats, degree, bits, flags, streams; in version 4 also where the directory lies.
_FIELDS = ((4, 4), (8, 4), (8, 4), (12, 1), (12, 1), (13, 1), (14, 1), (15, 1))


def sections(version: int, splats: int, degree: int, rng: Random) -> list[bytes]:
    """The content of positions, opacities, colours, scales, rotations and SH, random."""
    sizes = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1))
    return [rng.randbytes(size * splats) for size in sizes if size]


def legacy(version: int, splats: int, degree: int, content: bytes, bits: int = 12, flags: int = 0) -> bytes:
    """What versions 1 to 3 put into gzip."""
    return _HEADER.pack(b"NGSP", version, splats, degree, bits, flags, 0) + content


def streamed(splats: int, degree: int, streams: list[bytes], raw_sizes: list[int], flags: int = 0) -> bytes:
    """A file of version 4 from its Zstandard streams."""
    start = _HEADER.pack(b"NGSP", 4, splats, degree, 12, flags, len(streams)) + struct.pack("<I", 32) + bytes(12)
    directory = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, raw_sizes, strict=True))
    return start + directory + b"".join(streams)


def originals() -> list[bytes]:
    """Good files of every version and SH degree."""
    files, rng = [], Random(0)
    for version, degree in ((version, degree) for version in (1, 2, 3, 4) for degree in range(5)):
        parts = sections(version, 3, degree, rng)
        if version < 4:
            files.append(gzip.compress(legacy(version, 3, degree, b"".join(parts)), mtime=0))
        else:
            streams = [zstandard.ZstdCompressor().compress(part) for part in parts]
            files.append(streamed(3, degree, streams, [len(part) for part in parts]))
    return files


def changed(rng: Random) -> bytes:
    """A small file of a random version, changed."""
    version, splats, degree = rng.choice((1, 2, 3, 4)), rng.choice((1, 3, 20)), rng.randrange(5)
    parts = sections(version, splats, degree, rng)
    if version == 4:
        return _changed_streams(splats, degree, parts, rng)
    raw = legacy(version, splats, degree, b"".join(parts), flags=rng.choice((0, 0, 1, 2, 3)))
    raw = with_number(raw, rng, _FIELDS) if rng.random() < 0.6 else damaged(raw, rng)
    if rng.random() < 0.2:
        raw += rng.choice((bytes(100), rng.randbytes(5), bytes(1 << 16)))
    return gzipped(raw, rng)


def _changed_streams(splats: int, degree: int, raw: list[bytes], rng: Random) -> bytes:
    streams = []
    for part in raw:
        odd = rng.random()
        part = damaged(part, rng) if odd < 0.08 else part + bytes(1 << 16) if odd < 0.1 else part
        stored = zstandard.ZstdCompressor(level=1, write_content_size=rng.random() < 0.9).compress(part)
        streams.append(damaged(stored, rng) if rng.random() < 0.06 else stored)
    if rng.random() < 0.15:
        rng.shuffle(streams)
    out = streamed(splats, degree, streams, [len(part) for part in raw], rng.choice((0, 0, 1, 2, 3)))
    directory = tuple((32 + 8 * k, 8) for k in range(2 * len(raw)))
    if rng.random() < 0.6:
        out = with_number(out, rng, rng.choice((_FIELDS, directory, ((16, 4),))))
    return damaged(out, rng) if rng.random() < 0.15 else out


def gzip_originals() -> list[bytes]:
    """Good .ply.gz files."""
    return [gzip.compress(data, mtime=0) for data in ply_files.plain_originals()]


def changed_gzip(rng: Random) -> bytes:
    """A small .ply.gz file, changed in what is in it, or in how that is packed."""
    good = rng.random() < 0.5
    return gzipped(rng.choice(ply_files.plain_originals()) if good else ply_files.changed_plain(rng), rng)
