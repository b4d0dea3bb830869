"""Changes to bytes, numbers and texts that break parsers (:func:`damaged`, :func:`damaged_text`, :func:`strange`).

All of them take a ``random.Random``, so that a seed repeats them.
"""

from __future__ import annotations

import json
import struct
from random import Random
from typing import Any

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


def damaged_value(value: Any, rng: Random) -> Any:
    """A JSON value with one change somewhere inside it; ``value`` itself stays as it is."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        changed = dict(value)
        key = rng.choice(list(changed))
        kind = rng.randrange(8)
        if kind == 0:
            del changed[key]
        elif kind == 1:
            changed[rng.choice(TEXTS)] = strange(rng)
        elif kind == 2:
            changed[key] = strange(rng)
        else:
            changed[key] = damaged_value(changed[key], rng)
        return changed
    if isinstance(value, list) and value and rng.random() < 0.9:
        several = list(value)
        at = rng.randrange(len(several))
        kind = rng.randrange(8)
        if kind == 0:
            del several[at]
        elif kind == 1:
            several[at:at] = several[:2]
        elif kind == 2:
            several[at] = strange(rng)
        else:
            several[at] = damaged_value(several[at], rng)
        return several
    return strange(rng)


def damaged_json(data: bytes, rng: Random) -> bytes:
    """A JSON file with changed values, or changed as a text."""
    if rng.random() < 0.25:
        return damaged_text(data, rng)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # an earlier change has been here
        return damaged(data, rng)
    for _ in range(1 + rng.randrange(3)):
        value = damaged_value(value, rng)
    return json_bytes(value)


def json_bytes(value: Any) -> bytes:
    """A value as JSON, also where strict JSON has no word for it; nothing where it is nested too deeply."""
    try:
        return json.dumps(value).encode()
    except (RecursionError, ValueError):  # too deep, or an integer of too many digits
        return b"[" * 3000
