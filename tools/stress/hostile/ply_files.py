"""PLY, plain and compressed: small good files, and changes of headers line by line and of values in all layouts."""

from __future__ import annotations

import io
from functools import cache
from random import Random

import numpy as np
from plyfile import PlyData, PlyElement

from potr_cl.model.scene import SH_COEFFICIENTS
from tools.stress.hostile.changes import (
    NUMBERS,
    TEXTS,
    Files,
    damaged,
    damaged_text,
    interesting,
    interesting_double,
    packed_real,
    saved,
)  # fmt: skip

_TYPES = ("float", "double", "char", "uchar", "short", "ushort", "int", "uint", "float32", "float64", "uint8", "int64")
_END = b"end_header\n"


def names_of(degree: int, normals: bool = False) -> list[str]:
    """The properties of a splat in the original order."""
    rest = 3 * (SH_COEFFICIENTS[degree] - 1)
    return [
        *("x", "y", "z"), *(("nx", "ny", "nz") if normals else ()), *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)), "opacity", *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip


def plain(rng: Random) -> Files:
    """Three splats: as text or in a byte order, in single or double precision, with an element before or after."""
    return {"a.ply": _plain(rng.choice(("", "<", ">")), rng.choice((0, 1, 3)))}


@cache
def _plain(order: str, degree: int) -> bytes:
    names = names_of(degree, normals=degree == 0)
    rows = np.random.default_rng(degree).uniform(-2, 2, (3, len(names)))
    kinds = [(name, "f8" if degree == 1 else "f4") for name in names]
    elements = [PlyElement.describe(np.array([tuple(row) for row in rows], kinds), "vertex")]
    if degree == 1:
        before = np.array([(7, 8, 9)], [(name, "i4") for name in "abc"])
        elements.insert(0, PlyElement.describe(before, "camera"))
    if degree == 3:
        faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
        elements.append(PlyElement.describe(faces, "face"))
    out = io.BytesIO()
    PlyData(elements, text=not order, byte_order=order or "=", comments=["made to be changed"]).write(out)
    return out.getvalue()


def compressed(rng: Random) -> Files:
    """Of one chunk or two, of the SH degrees 0, 1 and 3."""
    return saved("a.compressed.ply", *rng.choice(((1, 0), (3, 1), (5, 3), (257, 0))))


def changed(files: Files, rng: Random) -> Files:
    """The header, line by line, or values."""
    ((name, data),) = files.items()
    if rng.random() < 0.1:
        return {name: damaged(data, rng)}
    header, end, body = data.partition(_END)
    lines = header.decode("latin-1").split("\n")[:-1]
    for _ in range(1 + rng.choice((0, 0, 1, 2))):
        if rng.random() < 0.65:
            _header_line(lines, rng)
        else:
            body = damaged_text(body, rng) if lines[1:2] == ["format ascii 1.0"] else _values(body, rng)
    if rng.random() < 0.15:  # room for what a header may claim besides
        body += rng.randbytes(rng.choice((16, 1000, 20_000)))
    head = "\n".join([*lines, ""]).encode("utf-8", "surrogatepass") + end
    return {name: (damaged_text(head, rng) if rng.random() < 0.15 else head) + body}


def _header_line(lines: list[str], rng: Random) -> None:
    """Change, add, move or drop a line of a header."""
    if not lines:
        return
    at, kind = rng.randrange(len(lines)), rng.randrange(10)
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
        lines.insert(rng.randrange(len(lines)), lines.pop(at))
    elif kind == 7:
        lines.insert(at, f"{rng.choice(('comment', 'obj_info', 'property float', 'element a'))} {rng.choice(TEXTS)}")
    elif kind == 8:
        words = lines[at].split(" ")
        orders = ("ascii", "binary_little_endian", "binary_big_endian")
        words[rng.randrange(len(words))] = rng.choice((*_TYPES, *orders, *NUMBERS, "list", "uint uint"))
        lines[at] = " ".join(words)
    else:
        count = rng.choice((1, 10, 300))
        lines[at:at] = [f"property {rng.choice(_TYPES)} p{i}_{rng.randrange(3)}" for i in range(count)]


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
