"""Changed PLY files, plain and compressed: headers line by line, values in all layouts."""

from __future__ import annotations

import struct
from functools import cache
from random import Random

import numpy as np

from potr_cl.model.scene import SH_COEFFICIENTS
from tools.stress.hostile.changes import (
    NUMBERS,
    TEXTS,
    damaged,
    damaged_text,
    interesting,
    interesting_double,
    packed_real,
)  # fmt: skip

_TYPES = ("float", "double", "char", "uchar", "short", "ushort", "int", "uint", "float32", "float64", "uint8", "int64")
_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
_END = b"end_header\n"
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
#: In the order in which they stand.
_BOUNDS = tuple(
    f"{end}_{prefix}{axis}"
    for prefix, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
    for end in ("min", "max")
    for axis in axes
)


def names_of(degree: int, normals: bool = False) -> list[str]:
    """The properties of a splat in the original order."""
    rest = 3 * (SH_COEFFICIENTS[degree] - 1)
    return [
        *("x", "y", "z"), *(("nx", "ny", "nz") if normals else ()), *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)), "opacity", *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip


@cache
def plain_originals() -> list[bytes]:
    """Good PLY files of a few splats: text and both byte orders, single and double, elements before and after."""
    rng = Random(1)
    files = []
    for layout in _FORMATS:
        for degree, kind, normals in ((0, "float", True), (1, "double", False), (3, "float", False)):
            names = names_of(degree, normals)
            rows = [[rng.uniform(-2, 2) for _ in names] for _ in range(3)]
            before = [(7, 8, 9)] if degree == 1 else []
            header = ["ply", f"format {layout} 1.0", "comment made to be changed"]
            if before:
                header += ["element camera 1", "property int a", "property int b", "property int c"]
            header += ["element vertex 3", *(f"property {kind} {name}" for name in names)]
            if degree == 3:
                header += ["element face 1", "property list uchar int vertex_indices"]
            if layout == "ascii":
                body = "".join(" ".join(map(str, row)) + "\n" for row in [*before, *rows])
                body += "3 0 1 2\n" if degree == 3 else ""
                content = body.encode()
            else:
                order = "<" if layout == "binary_little_endian" else ">"
                code = "f" if kind == "float" else "d"
                content = b"".join(struct.pack(f"{order}3i", *row) for row in before)
                content += b"".join(struct.pack(f"{order}{len(row)}{code}", *row) for row in rows)
                content += struct.pack(f"{order}B3i", 3, 0, 1, 2) if degree == 3 else b""
            files.append("\n".join([*header, ""]).encode() + _END + content)
    return files


@cache
def compressed_originals() -> list[bytes]:
    """Good compressed PLY files: one chunk and two, SH degrees 0, 1 and 3."""
    return [compressed(splats, degree) for splats, degree in ((1, 0), (3, 1), (5, 3), (257, 0))]


def compressed(splats: int, degree: int) -> bytes:
    """A compressed PLY of random splats."""
    rng = Random(splats)
    chunks, rest = -(-splats // 256), 3 * (SH_COEFFICIENTS[degree] - 1)
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    header += [f"property float {name}" for name in _BOUNDS]
    header += [f"element vertex {splats}", *(f"property uint {name}" for name in _PACKED)]
    if rest:
        header += [f"element sh {splats}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    bounds = np.array(([-2.0] * 3 + [2.0] * 3) * 3 * chunks, "<f4")
    return "\n".join([*header, ""]).encode() + _END + bounds.tobytes() + rng.randbytes((16 + rest) * splats)


def changed_plain(rng: Random) -> bytes:
    return _changed(rng.choice(plain_originals()), rng)


def changed_compressed(rng: Random) -> bytes:
    return _changed(rng.choice(compressed_originals()), rng)


def _changed(data: bytes, rng: Random) -> bytes:
    if rng.random() < 0.1:
        return damaged(data, rng)
    header, end, body = data.partition(_END)
    lines = header.decode("latin-1").split("\n")[:-1]
    for _ in range(1 + rng.choice((0, 0, 1, 2))):
        if rng.random() < 0.65:
            _header_line(lines, rng)
        elif lines[1:2] == ["format ascii 1.0"]:
            body = damaged_text(body, rng)
        else:
            body = _values(body, rng)
    if rng.random() < 0.15:  # room for what a header may claim besides
        body += rng.randbytes(rng.choice((16, 1000, 20_000)))
    head = "\n".join([*lines, ""]).encode("utf-8", "surrogatepass") + end
    if rng.random() < 0.08:
        head = damaged_text(head, rng)
    return head + body


def _header_line(lines: list[str], rng: Random) -> None:
    """Change, add, move or drop a line of a header."""
    if not lines:
        return
    at, kind = rng.randrange(len(lines)), rng.randrange(12)
    elements = [i for i, line in enumerate(lines) if line.startswith("element")]
    if kind <= 3 and elements:
        at = rng.choice(elements)
        words = [*lines[at].split(), "", "", ""][:3]
        if rng.random() < 0.75:
            words[2] = rng.choice((*NUMBERS, *"0124" * 8, str(interesting(rng, 4))))
        else:
            words[1] = rng.choice(("vertex", "chunk", "sh", "face", "Vertex", *TEXTS))
        lines[at] = _spaced(words, rng) + rng.choice(("", "", " ", "\t"))
    elif kind <= 5 and elements:  # an element said twice, the second time in spacing that only some parsers take
        start = rng.choice(elements)
        end = min((i for i in elements if i > start), default=len(lines))
        again = [_spaced(line.split(" "), rng) for line in lines[start:end]]
        again[0] = _spaced([*lines[start].split(" ")[:2], str(rng.choice((1, 4, 300, 600, 1000)))], rng)
        place = rng.choice((start, end))
        lines[place:place] = again
    elif kind == 6:
        del lines[at]
    elif kind == 7:
        other = rng.randrange(len(lines))
        lines[at], lines[other] = lines[other], rng.choice((lines[at], lines[other]))
    elif kind == 8:
        lines.insert(at, f"{rng.choice(('comment', 'obj_info', 'property float', 'element a'))} {rng.choice(TEXTS)}")
    elif kind == 9:
        words = lines[at].split(" ")
        words[rng.randrange(len(words))] = rng.choice((*_TYPES, *_FORMATS, *NUMBERS, "list", "uint uint"))
        lines[at] = " ".join(words)
    elif kind == 10:
        count = rng.choice((1, 10, 300))
        lines[at:at] = [f"property {rng.choice(_TYPES)} p{i}_{rng.randrange(3)}" for i in range(count)]
    else:
        lines[at] = damaged(lines[at].encode("utf-8", "surrogatepass"), rng).decode("latin-1")


def _spaced(words: list[str], rng: Random) -> str:
    return rng.choice((" ", " ", "  ", "\t", "\xa0", " \x0b")).join(words)


def _values(body: bytes, rng: Random) -> bytes:
    """Other bytes, or a number that few expect, where values stand."""
    if len(body) < 8 or rng.random() < 0.4:
        return damaged(body, rng)
    out = bytearray(body)
    for _ in range(1 + rng.randrange(4)):
        at = 4 * rng.randrange(len(out) // 4)
        packed = packed_real(interesting_double(rng), rng.choice(("<f", ">f", "<d", ">d")))
        out[at : at + len(packed)] = packed
    return bytes(out)
