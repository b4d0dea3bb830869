"""Changed gzipped scenes: what is in them, and how it is packed."""

from __future__ import annotations

import gzip
import struct
from random import Random

from tools.stress.hostile import ply_files
from tools.stress.hostile.changes import damaged, interesting


def originals() -> list[bytes]:
    """Good .ply.gz files."""
    return [gzip.compress(data, mtime=0) for data in ply_files.plain_originals()]


def changed(rng: Random) -> bytes:
    """A small .ply.gz file, changed."""
    good = rng.random() < 0.5
    raw = rng.choice(ply_files.plain_originals()) if good else ply_files.changed_plain(rng)
    packed = gzip.compress(raw, rng.choice((0, 1, 9)), mtime=0)
    kind = rng.randrange(8)
    if kind == 0:
        return raw
    if kind == 1:
        half = rng.randrange(len(raw) + 1)
        return gzip.compress(raw[:half], 1, mtime=0) + gzip.compress(raw[half:], 1, mtime=0)
    if kind == 2:
        return packed[:-8] + struct.pack("<II", interesting(rng, 4), len(raw))
    if kind == 3:
        return packed + rng.choice((b"\0" * 10, rng.randbytes(9), b"\x1f\x8b"))
    return damaged(packed, rng) if kind == 4 else packed
