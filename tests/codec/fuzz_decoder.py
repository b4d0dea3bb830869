"""Decode many mutated files in this process; the tests run it as a child, so that memory and hangs show.

python -m tests.codec.fuzz_decoder COUNT SEED: prints a JSON line with what happened.
"""

from __future__ import annotations

import json
import resource
import signal
import struct
import sys
import zlib
from collections import Counter

import numpy as np

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import PotrFile
from potr_cl.errors import PotrError
from potr_cl.pipeline.encode import encode
from potr_cl.reference.scenes import random_scene, ring_of_cameras
from potr_cl.report.file import file_report
from tests.cases.options import as_it_is

HEADER, ENTRY = 120, 24
SECONDS_A_FILE = 20  # a file of this size decodes in milliseconds: whatever reaches this hangs


def seeds() -> list[bytes]:
    coincident = random_scene(120, 1, seed=2).subset(np.r_[np.arange(120), np.arange(40), [3, 3]])
    encoded = [
        encode(random_scene(150, 3, seed=1), ring_of_cameras(6), as_it_is()),
        encode(coincident, None, as_it_is(entropy=EntropyCoder("npz"), q=0.3)),
        encode(random_scene(400, 0, seed=3), None, as_it_is(entropy=EntropyCoder("zstd", 1), q=1.0)),
        encode(random_scene(1, 0, seed=4), None, as_it_is()),
        encode(random_scene(1200, 2, seed=5), None, as_it_is("best")),
        encode(random_scene(200, 1, seed=6), ring_of_cameras(6), as_it_is("fast")),
    ]
    return [b"".join(e.pieces) for e in encoded]


def interesting(rng: np.random.Generator, size: int) -> int:
    """A value that breaks things: borders of types, small numbers, or anything."""
    top = 1 << (8 * size)
    choices = [0, 1, 2, top - 1, top // 2, top // 2 - 1, int(rng.integers(0, 256)), int(rng.integers(0, 1 << 16))]
    choices += [int(rng.integers(0, 1 << 63)), 1 << int(rng.integers(0, 8 * size))]
    return choices[rng.integers(len(choices))] % top


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One or more changes; mostly with all checksums made right again, so that the code behind them is met."""
    out = bytearray(data)
    seal = rng.random() < 0.75
    for _ in range(1 + rng.poisson(0.7)):
        kind = rng.integers(7)
        if kind == 0:  # bit flips anywhere
            for at in rng.integers(0, len(out), 1 + rng.poisson(2)):
                out[at] ^= 1 << rng.integers(8)
        elif kind == 1:  # cut
            del out[rng.integers(1, len(out)) :]
        elif kind == 2:  # insert or repeat
            at = rng.integers(0, len(out))
            out[at:at] = out[at : at + rng.integers(1, 60)]
        elif kind == 3:  # a field of the header
            at, size = [
                (8, 2),
                (10, 2),
                (12, 4),
                (16, 8),
                (24, 8),
                (32, 1),
                (33, 1),
                (34, 2),
                (40, 8),
                (64, 8),
                (72, 8),
                (104, 8),
            ][rng.integers(12)]
            out[at : at + size] = interesting(rng, size).to_bytes(size, "little")
        elif kind == 4 and len(out) > HEADER + ENTRY:  # a field of a table entry
            sections = max(1, struct.unpack_from("<H", out, 34)[0])
            at, size = [(0, 1), (1, 1), (2, 1), (3, 1), (8, 8), (16, 8)][rng.integers(6)]
            at += HEADER + ENTRY * int(rng.integers(sections))
            if at + size <= len(out):
                out[at : at + size] = interesting(rng, size).to_bytes(size, "little")
        elif kind == 5:  # stored bytes
            start = min(struct.unpack_from("<I", out, 12)[0], len(out) - 1) if len(out) > 16 else 0
            for at in rng.integers(start, len(out), 1 + rng.poisson(3)):
                out[at] = rng.integers(256)
        else:  # a claimed number of splats, all streams claiming to fit it
            splats = interesting(rng, int(rng.integers(1, 6)))
            out[24:32] = splats.to_bytes(8, "little")
            for i in range(struct.unpack_from("<H", out, 34)[0] if len(out) > 36 else 0):
                at = HEADER + ENTRY * i
                if at + ENTRY <= len(out) and out[at] >= 16:
                    struct.pack_into("<Q", out, at + 8, splats * max(1, out[at + 3]) % (1 << 64))
        if len(out) < 2:
            break
    return reseal(out) if seal else bytes(out)


def reseal(out: bytearray) -> bytes:
    """Right checksums and file size for whatever the header and the table say now."""
    if len(out) < HEADER + 4:
        return bytes(out)
    header = struct.unpack_from("<I", out, 12)[0]
    sections = struct.unpack_from("<H", out, 34)[0]
    if header != HEADER + ENTRY * sections + 4 or header > len(out):
        return bytes(out)
    struct.pack_into("<Q", out, 16, len(out))
    offset = header
    for i in range(sections):
        at = HEADER + ENTRY * i
        stored = struct.unpack_from("<Q", out, at + 16)[0]
        struct.pack_into("<I", out, at + 4, zlib.crc32(out[offset : offset + stored]))
        offset += stored
    struct.pack_into("<I", out, header - 4, zlib.crc32(out[: header - 4]))
    return bytes(out)


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main() -> None:
    count, seed = int(sys.argv[1]), int(sys.argv[2])
    rng = np.random.default_rng(seed)
    originals = seeds()
    for original in originals:
        PotrFile.from_bytes(original).scene()
    before = peak_bytes()
    outcomes: Counter[str] = Counter()
    honest = 0
    lines: set[str] = set()  # beyond the one that a message may have
    for _ in range(count):
        data = mutate(originals[rng.integers(len(originals))], rng)
        signal.alarm(SECONDS_A_FILE)
        try:
            scene = PotrFile.from_bytes(data).scene()
            file_report(PotrFile.from_bytes(data))
        except PotrError as error:
            outcomes["refused"] += 1
            lines.update(str(error).splitlines()[1:])
        else:
            assert len(scene) >= 1
            assert np.isfinite(scene.means).all()
            assert np.isfinite(scene.log_scales).all()
            assert np.isfinite(scene.quaternions).all()
            assert np.isfinite(scene.opacity_logits).all()
            assert np.isfinite(scene.sh).all()
            honest = max(honest, scene.nbytes)
            outcomes["decoded"] += 1
        signal.alarm(0)
    assert not lines
    print(json.dumps({**outcomes, "growth": peak_bytes() - before, "honest": honest}))


if __name__ == "__main__":
    main()
