"""Changed .splat and .ksplat files: rows of any bytes, headers of sections and their buckets."""

from __future__ import annotations

import struct
from random import Random

from tools.stress.hostile.changes import damaged, interesting, interesting_double

_COEFFICIENTS = (0, 9, 24, 45)


def splat_originals() -> list[bytes]:
    """Good .splat files."""
    return [_rows(count, Random(count)) for count in (1, 3, 40)]


def changed_splat(rng: Random) -> bytes:
    """A small .splat file, changed."""
    data = bytearray(_rows(rng.choice((1, 3, 20)), rng))
    for _ in range(rng.randrange(3)):
        at = rng.randrange(len(data) // 4) * 4
        data[at : at + 4] = _float(interesting_double(rng))
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
    sections = [_section(level, degree, rng.choice((0, 1, 5, 30)), rng) for degree in degrees]
    out = bytearray(_ksplat(level, sections))
    kind = rng.randrange(6)
    if kind == 0:
        at, size = rng.choice(((0, 1), (1, 1), (4, 4), (8, 4), (12, 4), (16, 4), (20, 2), (36, 4), (40, 4)))
        out[at : at + size] = interesting(rng, size).to_bytes(size, "little")
    elif kind < 4:
        start = 4096 + 1024 * rng.randrange(len(sections))
        for _ in range(1 + rng.randrange(2)):
            at, size = rng.choice(
                ((0, 4), (4, 4), (8, 4), (12, 4), (16, 4), (20, 2), (24, 4), (28, 4), (32, 4), (36, 4), (40, 2))
            )
            old = int.from_bytes(out[start + at : start + at + size], "little")
            new = rng.choice((interesting(rng, size), old + 1, max(old - 1, 0))) % (1 << 8 * size)
            out[start + at : start + at + size] = new.to_bytes(size, "little")
    elif kind == 4 and len(out) > 5120:
        at = rng.randrange(5120, len(out))
        out[at : at + 4] = interesting(rng, 4).to_bytes(4, "little")
    return damaged(bytes(out), rng) if rng.random() < 0.2 else bytes(out)


def _rows(count: int, rng: Random) -> bytes:
    rows = []
    for _ in range(count):
        numbers = [rng.uniform(-2, 2) for _ in range(3)] + [rng.uniform(0, 1) for _ in range(3)]
        rows.append(struct.pack("<6f", *numbers) + rng.randbytes(8))
    return b"".join(rows)


def _float(value: float) -> bytes:
    """Of any double, also one that single precision has not."""
    try:
        return struct.pack("<f", value)
    except OverflowError:
        return struct.pack("<f", float("inf"))


def _section(level: int, degree: int, count: int, rng: Random) -> tuple[bytes, bytes]:
    """A section's header and content: a full bucket of four, and another."""
    full = 1 if count >= 4 else 0
    lengths = [count - 4 * full] if count - 4 * full else []
    buckets = (full + len(lengths)) if level else 0
    content = b""
    if level:
        content += struct.pack(f"<{len(lengths)}I", *lengths)
        content += struct.pack(f"<{3 * buckets}f", *(rng.uniform(-9, 9) for _ in range(3 * buckets)))
    for _ in range(count):
        if level == 0:
            content += struct.pack("<10f", *(rng.uniform(0.01, 1) for _ in range(10))) + rng.randbytes(4)
            content += struct.pack(
                f"<{_COEFFICIENTS[degree]}f", *(rng.uniform(-1, 1) for _ in range(_COEFFICIENTS[degree]))
            )
        else:
            content += (
                rng.randbytes(6) + struct.pack("<7e", *(rng.uniform(0.01, 1) for _ in range(7))) + rng.randbytes(4)
            )
            values = [rng.uniform(-1, 1) for _ in range(_COEFFICIENTS[degree])]
            content += struct.pack(f"<{len(values)}e", *values) if level == 1 else rng.randbytes(len(values))
    packed = (4, buckets, 5.0, 12, 32767) if level else (0, 0, 0.0, 0, 0)
    others = len(lengths) if level else 0
    header = struct.pack("<IIIIfHxxIIIIH", count, count, *packed, len(content), full if level else 0, others, degree)
    return header.ljust(1024, b"\0"), content


def _ksplat(level: int, sections: list[tuple[bytes, bytes]]) -> bytes:
    splats = sum(struct.unpack_from("<I", header)[0] for header, _ in sections)
    start = struct.pack(
        "<BBxxIIIIHxx3f2f", 0, 1, len(sections), len(sections), splats, splats, level, 0, 0, 0, -1.5, 1.5
    )
    headers, contents = (b"".join(part) for part in zip(*sections, strict=True))
    return start.ljust(4096, b"\0") + headers + contents
