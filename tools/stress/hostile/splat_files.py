"""Changed .splat and .ksplat files: rows of any bytes, headers of sections and their buckets."""

from __future__ import annotations

import struct
from random import Random

from tools.stress.hostile.changes import damaged, interesting_double, packed_real, with_number

_COEFFICIENTS = (0, 9, 24, 45)
#: Of the file's header, and of a section's.
_HEAD = ((0, 1), (1, 1), (4, 4), (8, 4), (12, 4), (16, 4), (20, 2), (36, 4), (40, 4))
_SECTION = ((0, 4), (4, 4), (8, 4), (12, 4), (16, 4), (20, 2), (24, 4), (28, 4), (32, 4), (36, 4), (40, 2))


def splat_originals() -> list[bytes]:
    """Good .splat files."""
    return [_rows(count, Random(count)) for count in (1, 3, 40)]


def changed_splat(rng: Random) -> bytes:
    """A small .splat file, changed."""
    data = bytearray(_rows(rng.choice((1, 3, 20)), rng))
    for _ in range(rng.randrange(3)):
        at = rng.randrange(len(data) // 4) * 4
        data[at : at + 4] = packed_real(interesting_double(rng), "<f")
    return damaged(bytes(data), rng) if rng.random() < 0.5 else bytes(data)


def ksplat_originals() -> list[bytes]:
    """Good .ksplat files of every compression level and SH degree, with one section and with several."""
    return [
        _ksplat(level, [_section(level, degree, count, Random(level)) for count in counts])
        for level in range(3)
        for degree in range(4)
        for counts in ((7,), (5, 0, 20))
    ]


def changed_ksplat(rng: Random) -> bytes:
    """A small .ksplat file, changed."""
    level = rng.randrange(3)
    degrees = rng.choices(range(4), k=rng.choice((1, 1, 2, 3)))
    out = _ksplat(level, [_section(level, degree, rng.choice((0, 1, 5, 30)), rng) for degree in degrees])
    start = 4096 + 1024 * rng.randrange(len(degrees))
    content = [(at, 4) for at in range(4096 + 1024 * len(degrees), len(out) - 4, 4)]
    fields = rng.choice((_HEAD, *([[(start + at, size) for at, size in _SECTION]] * 3), content))
    if fields and rng.random() < 0.9:
        out = with_number(out, rng, fields)
    return damaged(out, rng) if rng.random() < 0.2 else out


def _reals(rng: Random, count: int, low: float, high: float, code: str = "f") -> bytes:
    return struct.pack(f"<{count}{code}", *(rng.uniform(low, high) for _ in range(count)))


def _rows(count: int, rng: Random) -> bytes:
    return b"".join(_reals(rng, 3, -2, 2) + _reals(rng, 3, 0, 1) + rng.randbytes(8) for _ in range(count))


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


def _ksplat(level: int, sections: list[tuple[bytes, bytes]]) -> bytes:
    splats, number = sum(struct.unpack_from("<I", header)[0] for header, _ in sections), len(sections)
    start = struct.pack("<BBxxIIIIHxx3f2f", 0, 1, number, number, splats, splats, level, 0, 0, 0, -1.5, 1.5)
    headers, contents = (b"".join(part) for part in zip(*sections, strict=True))
    return start.ljust(4096, b"\0") + headers + contents
