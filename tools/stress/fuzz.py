"""Decode files that were changed at random.

    python -m tools.stress.fuzz COUNT SEED FILE.potr …

Takes COUNT times one of the given files, changes something in it (mostly so that checksums are right again, so that the
code behind them is met), decodes it and makes its report. A changed file may be refused or decode to finite numbers;
anything else ends the program: another error than the package's own, a hang, values that are not finite. Prints a line
of JSON: how many were "refused" and "decoded", by how many bytes the process grew ("growth"), and the size of the
largest scene that decoded ("honest").
"""

from __future__ import annotations

import argparse
import json
import resource
import signal
import struct
import zlib
from collections import Counter
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import PotrFile
from potr_cl.errors import PotrError
from potr_cl.report.file import file_report

#: Sizes of the header without its table, and of a table entry, bytes (docs/format.md).
HEADER, ENTRY = 120, 24
#: Fields of the header, and of a table entry: offset and size.
HEADER_FIELDS = [
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
]
ENTRY_FIELDS = [(0, 1), (1, 1), (2, 1), (3, 1), (8, 8), (16, 8)]
#: Files of some thousand splats decode in milliseconds: whatever takes this long hangs.
SECONDS_A_FILE = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, help="changed files to decode")
    parser.add_argument("seed", type=int, help="of the changes")
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.potr", help="to change")
    args = parser.parse_args()
    print(json.dumps(fuzz(args.count, args.seed, [path.read_bytes() for path in args.files])))


def fuzz(count: int, seed: int, originals: list[bytes]) -> dict[str, int]:
    """Decode ``count`` changed files; what happened, by name."""
    rng = np.random.default_rng(seed)
    for original in originals:
        PotrFile.from_bytes(original).scene()
    before = peak_bytes()
    outcomes: Counter[str] = Counter()
    honest = 0
    for _ in range(count):
        data = mutate(originals[rng.integers(len(originals))], rng)
        signal.alarm(SECONDS_A_FILE)
        try:
            scene = PotrFile.from_bytes(data).scene()
            file_report(PotrFile.from_bytes(data))
        except PotrError as error:
            outcomes["refused"] += 1
            if len(str(error).splitlines()) > 1:
                raise SystemExit(f"a message of more than one line: {error}") from None
        else:
            values = (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh)
            if len(scene) < 1 or not all(np.isfinite(array).all() for array in values):
                raise SystemExit("a changed file decodes to no splats or to values that are not finite")
            honest = max(honest, scene.nbytes)
            outcomes["decoded"] += 1
        signal.alarm(0)
    return {**outcomes, "growth": peak_bytes() - before, "honest": honest}


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
            at, size = HEADER_FIELDS[rng.integers(len(HEADER_FIELDS))]
            out[at : at + size] = interesting(rng, size).to_bytes(size, "little")
        elif kind == 4 and len(out) > HEADER + ENTRY:  # a field of a table entry
            sections = max(1, struct.unpack_from("<H", out, 34)[0])
            at, size = ENTRY_FIELDS[rng.integers(len(ENTRY_FIELDS))]
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


if __name__ == "__main__":
    main()
