""".splat, .ksplat, SPZ of versions 1 to 4 and gzipped PLY: small good files, and changes of them."""

from __future__ import annotations

import gzip
import struct
from random import Random

import zstandard

from tools.stress.hostile import ply_files
from tools.stress.hostile.changes import Files, Rules, damaged, gzipped, with_number

_COEFFICIENTS = (0, 9, 24, 45)
#: Of a .ksplat file's header, and of a section's.
_HEAD = ((0, 1), (1, 1), (4, 4), (8, 4), (12, 4), (16, 4), (20, 2), (36, 4), (40, 4))
_SECTION = ((0, 4), (4, 4), (8, 4), (12, 4), (16, 4), (20, 2), (24, 4), (28, 4), (32, 4), (36, 4), (40, 2))
_SPZ = struct.Struct("<4sIIBBBB")
#: Version, splats, degree, bits, flags, streams; in version 4 also where the directory lies.
_SPZ_FIELDS = ((4, 4), (8, 4), (8, 4), (12, 1), (12, 1), (13, 1), (14, 1), (15, 1))


def _reals(rng: Random, count: int, low: float, high: float, code: str = "f") -> bytes:
    return struct.pack(f"<{count}{code}", *(rng.uniform(low, high) for _ in range(count)))


def splat(rng: Random) -> Files:
    rows = (_reals(rng, 3, -2, 2) + _reals(rng, 3, 0, 1) + rng.randbytes(8) for _ in range(rng.choice((1, 3, 20))))
    return {"a.splat": b"".join(rows)}


SPLAT = Rules(fields=lambda name, data: [(at, 4) for at in range(0, len(data) - 3, 4)])


def ksplat(rng: Random, level: int | None = None) -> Files:
    """Of any compression level, with one to three sections of any SH degree."""
    level = rng.randrange(3) if level is None else level
    counts = (rng.choice((1, 5, 30)), *rng.choice(((), (), (0,), (0, 20))))
    sections = [_section(level, rng.randrange(4), count, rng) for count in counts]
    total, number = sum(counts), len(counts)
    start = struct.pack("<BBxxIIIIHxx3f2f", 0, 1, number, number, total, total, level, 0, 0, 0, -1.5, 1.5)
    headers, contents = (b"".join(part) for part in zip(*sections, strict=True))
    return {"a.ksplat": start.ljust(4096, b"\0") + headers + contents}


def _section(level: int, degree: int, count: int, rng: Random) -> tuple[bytes, bytes]:
    """A section's header and content: a full bucket of four, and another."""
    full = 1 if level and count >= 4 else 0
    lengths = [count - 4 * full] if level and count - 4 * full else []
    buckets, content = full + len(lengths), b""
    if level:
        content += struct.pack(f"<{len(lengths)}I", *lengths) + _reals(rng, 3 * buckets, -9, 9)
    for _ in range(count):
        if level == 0:
            content += _reals(rng, 10, 0.01, 1) + rng.randbytes(4)
        else:
            content += rng.randbytes(6) + _reals(rng, 7, 0.01, 1, "e") + rng.randbytes(4)
        values = _COEFFICIENTS[degree]
        content += rng.randbytes(values) if level == 2 else _reals(rng, values, -1, 1, "fe"[level])
    packed = (4, buckets, 5.0, 12, 32767) if level else (0, 0, 0.0, 0, 0)
    header = struct.pack("<IIIIfHxxIIIIH", count, count, *packed, len(content), full, len(lengths), degree)
    return header.ljust(1024, b"\0"), content


def _ksplat_fields(name: str, data: bytes) -> list[tuple[int, int]]:
    sections = [(4096 + 1024 * k + at, size) for k in range(3) for at, size in _SECTION]
    places = [*_HEAD, *sections, *((at, 4) for at in range(5120, len(data), 68))]
    return [(at, size) for at, size in places if at + size <= len(data)]


KSPLAT = Rules(fields=_ksplat_fields)


def spz(rng: Random) -> Files:
    version, splats, degree = rng.choice((1, 2, 3, 4)), rng.choice((1, 3, 20)), rng.randrange(5)
    sizes = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1))
    parts = [rng.randbytes(size * splats) for size in sizes if size]
    if version < 4:
        return {"a.spz": gzip.compress(spz_content(version, splats, degree, b"".join(parts)), mtime=0)}
    streams = [zstandard.ZstdCompressor().compress(part) for part in parts]
    return {"a.spz": spz_of_streams(splats, degree, streams, [len(part) for part in parts])}


def spz_content(version: int, splats: int, degree: int, content: bytes, flags: int = 0) -> bytes:
    """What versions 1 to 3 put into gzip."""
    return _SPZ.pack(b"NGSP", version, splats, degree, 12, flags, 0) + content


def spz_of_streams(splats: int, degree: int, streams: list[bytes], raw_sizes: list[int], flags: int = 0) -> bytes:
    """A file of version 4."""
    start = _SPZ.pack(b"NGSP", 4, splats, degree, 12, flags, len(streams)) + struct.pack("<I", 32) + bytes(12)
    directory = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, raw_sizes, strict=True))
    return start + directory + b"".join(streams)


def changed_spz(files: Files, rng: Random) -> Files:
    """In its header, in its directory, or behind its coder."""
    data = files["a.spz"]
    if data.startswith(b"NGSP"):
        return {"a.spz": _changed_streams(data, rng)}
    raw = gzip.decompress(data)
    raw = with_number(raw, rng, _SPZ_FIELDS) if rng.random() < 0.6 else damaged(raw, rng)
    if rng.random() < 0.2:
        raw += rng.choice((bytes(100), rng.randbytes(5), bytes(1 << 16)))
    return {"a.spz": gzipped(raw, rng)}


def _changed_streams(data: bytes, rng: Random) -> bytes:
    _, _, splats, degree, _, _, count = _SPZ.unpack_from(data)
    at, sizes, streams = 32 + 16 * count, struct.unpack_from(f"<{2 * count}Q", data, 32), []
    for size in sizes[::2]:
        raw, odd = zstandard.ZstdDecompressor().decompress(data[at : at + size]), rng.random()
        raw = damaged(raw, rng) if odd < 0.08 else raw + bytes(1 << 16) if odd < 0.1 else raw
        stored = zstandard.ZstdCompressor(level=1, write_content_size=rng.random() < 0.9).compress(raw)
        streams.append(damaged(stored, rng) if rng.random() < 0.06 else stored)
        at += size
    if rng.random() < 0.15:
        rng.shuffle(streams)
    out = spz_of_streams(splats, degree, streams, list(sizes[1::2]), rng.choice((0, 0, 1, 2, 3)))
    directory = tuple((32 + 8 * k, 8) for k in range(2 * count))
    if rng.random() < 0.6:
        out = with_number(out, rng, rng.choice((_SPZ_FIELDS, directory, ((16, 4),))))
    return damaged(out, rng) if rng.random() < 0.15 else out


def gzipped_ply(rng: Random) -> Files:
    return {"a.ply.gz": gzip.compress(ply_files.plain(rng)["a.ply"], mtime=0)}


def changed_gzip(files: Files, rng: Random) -> Files:
    """In what is in it, or in how that is packed."""
    raw = {"a.ply": gzip.decompress(files["a.ply.gz"])}
    return {"a.ply.gz": gzipped((raw if rng.random() < 0.5 else ply_files.changed(raw, rng))["a.ply"], rng)}
