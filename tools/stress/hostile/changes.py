"""Changes that break parsers, of one file or several (:class:`Rules`), of bytes, numbers, texts and JSON.

All of them take a ``random.Random``, so that a seed repeats them. A format says only what its good files are, and what
is worth changing in them.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
import struct
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

from potr_cl.formats import save_scene
from tests.reference.scenes import random_scene

#: A file or several that belong together, by their names; the first is what is read.
Files = dict[str, bytes]

#: Numbers as a text file may spell them.
NUMBERS = (
    "0", "-0", "1", "-1", "2", "3.5", "1e400", "-1e400", "1e-400", "nan", "inf", "-Infinity", "NaN", "0x10", "1_000",
    "1e", "--1", "+1", "1.0.0", "", " ", "²", "１", "9" * 20, "9" * 400, "-9223372036854775808", "18446744073709551616",
    "2147483648", "4294967295", "1e38", "3.5e38", "1e308", "0." + "0" * 300 + "1", "1,5", "1d5", "True",
)  # fmt: skip
#: Texts that harm whoever shows, opens or stores them.
TEXTS = (
    "", " ", "\x1b[2J\x1b]0;title\x07", "a\nb", "a\rb", "a\0b", "../../../../etc/passwd", "/dev/zero", "/dev/stdin",
    "~/x", "$(touch x)", "`touch x`", "%s%n", "{0.__class__}", "\ud800", "\u202egnp.exe", "ä" * 300, "a" * 5000,
    "con", "C:\\x", "x.png\0.exe", "<script>", "'; --", "\ufeff", "\x7f\x80\x9b31m", "__proto__", "images/../a.png",
)  # fmt: skip


def interesting(rng: Random, size: int) -> int:
    """An unsigned integer of some bytes: borders of types, small ones, or anything."""
    top = 1 << (8 * size)
    kind = rng.randrange(9)
    if kind < 5:
        return (0, 1, top - 1, top // 2, top // 2 - 1)[kind]
    if kind == 5:
        return rng.randrange(256)
    if kind == 6:
        return rng.randrange(1 << min(16, 8 * size))
    return rng.randrange(top) if kind == 7 else 1 << rng.randrange(8 * size)


def interesting_double(rng: Random) -> float:
    """A number at the limits of single or double precision, or any bits at all."""
    choices = (
        0.0, -0.0, 1.0, -1.0, 0.5, 1e-3, 9e-4, 1e9, 2e9, 1e38, -3.5e38, 3.4028234e38, 3.4028236e38, 1e308, 5e-324,
        1e-45, float("inf"), -float("inf"), float("nan"), 2.0**24, 2.0**53, 2.0**63,
    )  # fmt: skip
    if rng.random() < 0.2:
        return float(struct.unpack("<d", rng.randbytes(8))[0])
    return rng.choice(choices)


def damaged(data: bytes, rng: Random) -> bytes:
    """Bytes with one change: flipped bits, others in their place, some cut, repeated, moved, or numbers put in."""
    if not data:
        return rng.randbytes(rng.randrange(1, 20))
    out = bytearray(data)
    at = rng.randrange(len(out))
    kind = rng.randrange(8)
    if kind == 0:
        for _ in range(1 + rng.randrange(4)):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        for _ in range(1 + rng.randrange(4)):
            out[rng.randrange(len(out))] = rng.randrange(256)
    elif kind == 2:
        del out[at:]
    elif kind == 3:
        del out[at : at + rng.randrange(1, 17)]
    elif kind == 4:
        out[at:at] = out[at : at + rng.randrange(1, 60)] * rng.randrange(1, 4)
    elif kind == 5:
        out[at:at] = bytes([rng.choice((0, 255, rng.randrange(256)))]) * rng.randrange(1, 60)
    elif kind == 6:
        size = rng.choice((1, 2, 4, 8))
        out[at : at + size] = interesting(rng, size).to_bytes(size, rng.choice(("little", "big")))
    else:
        other = rng.randrange(len(out))
        size = rng.randrange(1, 33)
        out[at : at + size] = out[other : other + size]
    return bytes(out)


def damaged_text(data: bytes, rng: Random) -> bytes:
    """A text with one change: to a word, a number, a line, its white space, its line ends, or a byte."""
    kind = rng.randrange(7)
    if kind == 0:
        return damaged(data, rng)
    if kind == 1:
        ends = rng.choice((b"\r\n", b"\r", b"\n\n", b"\x0b", b"\x85", b"\n \n"))
        return data.replace(b"\n", ends, rng.choice((1, 3, -1)))
    if kind == 2:
        return data.replace(b" ", rng.choice((b"  ", b"\t", b"\xa0", b"", b" \x0c")), rng.choice((1, 3, -1)))
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    if kind == 3:
        del lines[at]
    elif kind == 4:
        lines[at:at] = [lines[rng.randrange(len(lines))]] * rng.randrange(1, 4)
    else:
        words = lines[at].split(b" ")
        word = rng.choice(NUMBERS) if rng.random() < 0.7 else rng.choice(TEXTS)
        words[rng.randrange(len(words))] = word.encode("utf-8", "surrogatepass")
        lines[at] = b" ".join(words)
    return b"\n".join(lines)


def strange(rng: Random) -> Any:
    """A value that JSON can hold and that nobody expects."""
    kind = rng.randrange(8)
    if kind == 0:
        return rng.choice(TEXTS)
    if kind == 1:
        return rng.choice((None, True, False, [], {}, [[]], [None], {"": 0}, "nan", "1"))
    if kind == 2:
        return rng.choice((0, 1, -1, 2**31, 2**53 + 1, 2**63, 2**64, -(2**63), 10**19, 10**400, 65536, 65537))
    if kind == 3:
        nested: Any = 0
        for _ in range(rng.choice((2, 50, 900))):
            nested = [nested] if kind % 2 else {"a": nested}
        return nested
    if kind == 4:
        return [strange(rng) for _ in range(rng.randrange(5))]
    if kind == 5:
        return [0.0] * rng.choice((1, 2, 3, 4, 16, 256, 257))
    return interesting_double(rng)


Hints = Mapping[str, Sequence[Any]]


def damaged_value(value: Any, rng: Random, hints: Hints | None = None) -> Any:
    """A JSON value with one change somewhere inside it; ``value`` itself stays as it is.

    Args:
        hints: values for keys that mean something, and keys that could be there.
    """
    hints = hints or {}
    kind = rng.randrange(8)
    if isinstance(value, dict) and value and rng.random() < 0.9:
        changed = dict(value)
        key = rng.choice(list(changed))
        if kind == 0:
            del changed[key]
        elif kind == 1:
            key = rng.choice([*TEXTS, *hints])
            changed[key] = strange(rng)
        elif kind == 2:
            changed[key] = strange(rng)
        else:
            inside = isinstance(changed[key], (dict, list)) and (key not in hints or rng.random() < 0.7)
            at_hand = key in hints and not inside
            changed[key] = rng.choice(hints[key]) if at_hand else damaged_value(changed[key], rng, hints)
        return changed
    if isinstance(value, list) and value and rng.random() < 0.9:
        several = list(value)
        at = rng.randrange(len(several))
        if kind == 0:
            del several[at]
        elif kind == 1:
            several[at:at] = several[:2]
        else:
            several[at] = strange(rng) if kind == 2 else damaged_value(several[at], rng, hints)
        return several
    return strange(rng)


def damaged_json(data: bytes, rng: Random, hints: Hints | None = None) -> bytes:
    """A JSON file with changed values, or changed as a text."""
    if rng.random() < 0.2:
        return damaged_text(data, rng)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # an earlier change has been here
        return damaged(data, rng)
    for _ in range(1 + rng.choice((0, 0, 1, 2))):
        value = damaged_value(value, rng, hints)
    try:
        return json.dumps(value).encode()
    except (RecursionError, ValueError):  # too deep, or an integer of too many digits
        return b"[" * 3000


# ---------------------------------------------------------------------------------------------------- files


@cache
def saved(name: str, splats: int, degree: int) -> Files:
    """What the package writes of a random scene under a name, which comes first."""
    with tempfile.TemporaryDirectory() as folder:
        save_scene(Path(folder, name), random_scene(splats, degree, seed=splats))
        others = sorted(path.name for path in Path(folder).iterdir() if path.name != name)
        return {each: Path(folder, each).read_bytes() for each in (name, *others)}


@dataclasses.dataclass(frozen=True)
class Rules:
    """What is worth changing in the files of a format.

    Attributes:
        hints: of JSON (:func:`damaged_value`).
        fields: where numbers stand in a file of a name: offsets and sizes, with minus for big endian.
        others: makes another content for a file of a name now and then.
        beside: files that may lie beside, by name, some of which are put there now and then.
    """

    hints: Hints = dataclasses.field(default_factory=dict)
    fields: Callable[[str, bytes], Sequence[tuple[int, int]]] = lambda name, data: ()
    others: Callable[[str, bytes, Random], bytes | None] = lambda name, data, rng: None
    beside: Mapping[str, Sequence[bytes]] = dataclasses.field(default_factory=dict)

    def changed(self, files: Files, rng: Random) -> Files:
        """Some files with one to three changes: of the first, mostly, of others, or of which there are."""
        files = dict(files)
        for _ in range(1 + rng.choice((0, 0, 1))):
            names = list(files)
            name = names[0] if rng.random() < 0.5 else rng.choice(names)
            if len(names) > 1 and rng.random() < 0.08:
                other = rng.choice(names[1:])
                files[other], files[name] = files[name], files[other]
            elif len(names) > 1 and rng.random() < 0.08:
                del files[rng.choice(names[1:])]
            elif self.beside and rng.random() < 0.15:
                beside = rng.choice(list(self.beside))
                files[beside] = rng.choice(self.beside[beside])
            else:
                files[name] = self._of_one(name, files[name], rng)
        return files

    def _of_one(self, name: str, data: bytes, rng: Random) -> bytes:
        other = self.others(name, data, rng) if rng.random() < 0.4 else None
        if other is not None:
            return other
        fields = self.fields(name, data) if data and rng.random() < 0.75 else ()
        if fields:
            return with_number(data, rng, fields)
        if name.endswith((".json", ".gltf")):
            return damaged_json(data, rng, self.hints)
        return damaged_text(data, rng) if name.endswith(".txt") else damaged(data, rng)


def with_number(data: bytes, rng: Random, fields: Sequence[tuple[int, int]]) -> bytes:
    """A file in one or two of whose fields another number stands."""
    out = bytearray(data)
    for _ in range(1 + rng.randrange(2)):
        at, signed_size = rng.choice(fields)
        size, order = abs(signed_size), "<" if signed_size > 0 else ">"
        byteorder: Any = "little" if signed_size > 0 else "big"
        old = int.from_bytes(out[at : at + size], byteorder)
        if size in (4, 8) and rng.random() < 0.2:
            out[at : at + size] = packed_real(interesting_double(rng), order + "fd"[size == 8])
        else:
            number = rng.choice((interesting(rng, size), rng.randrange(9), old + 1, max(old - 1, 0)))
            out[at : at + size] = (number % (1 << 8 * size)).to_bytes(size, byteorder)
    return bytes(out)


def packed_real(value: float, code: str) -> bytes:
    """Of any double, also one that single precision has not."""
    try:
        return struct.pack(code, value)
    except OverflowError:
        return struct.pack(code, float("inf"))


def gzipped(raw: bytes, rng: Random) -> bytes:
    """Packed by gzip: as it should be, or with members, sums, names or ends that few expect."""
    kind = rng.randrange(10)
    packed = gzip.compress(raw, rng.choice((0, 1, 9)), mtime=0)
    if kind == 0:
        return raw  # not packed at all
    if kind == 1:  # several members, one after another
        half = rng.randrange(len(raw) + 1)
        return gzip.compress(raw[:half], 1, mtime=0) + gzip.compress(raw[half:], 1, mtime=0)
    if kind == 2:  # a name, a comment and more in gzip's own header
        return b"\x1f\x8b\x08\x1c" + bytes(6) + b"\3\0abc" + b"\x1b[2Jname\0comment\0" + packed[10:]
    if kind == 3:
        return packed + rng.choice((b"\0" * 10, rng.randbytes(9), packed, b"\x1f\x8b"))
    if kind == 4:  # the sizes at the end say something else
        return packed[:-8] + struct.pack("<II", interesting(rng, 4), len(raw))
    return damaged(packed, rng) if kind == 5 else packed
