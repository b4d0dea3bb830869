"""SOG archives, folders, streamed folders with levels: small good ones of the package's own making, and what is worth
changing in them, in descriptions and in pictures."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from functools import cache
from random import Random
from typing import Any

import numpy as np
from PIL import Image

from tools.stress.hostile.changes import TEXTS, Files, Rules, damaged, interesting, saved, with_number

_NAMES: tuple[Any, ...] = (
    ["../meta.json"] * 2, ["/dev/zero", "a/../../b"], [], ["meta.json"] * 2, ["quats.webp", "scales.webp"], "abc",
    [0, None],
)  # fmt: skip
_COUNTS = (0, 1, 2, 5, 16, 17, 64, 65537, -1, 1.0, True, None, "5", 10**9, 2**31, 2**40)
_BOUNDS: tuple[Any, ...] = (
    [], [0], [1e39] * 3, [800.0] * 3, ["1", 2, 3], [[1, 2, 3]] * 3, 5, None, [float("nan")] * 3, [1, 2, 3, 4],
)  # fmt: skip
_HINTS = {
    **dict.fromkeys(("count", "file", "offset", "lodLevels"), _COUNTS), **dict.fromkeys(("mins", "maxs"), _BOUNDS),
    **dict.fromkeys(("files", "filenames", "environment"), _NAMES), "bands": (0, 1, 2, 3, 4, 1.0, True, "1"),
    "version": (1, 2, 2.0, 3, None, "2", [2], "\x1b[2J"),
}  # fmt: skip


@cache
def picture(width: int, height: int, kind: str = "WEBP", mode: str = "RGBA", lossless: bool = True) -> bytes:
    """A picture of noise; opaque in the channel that says which part of a rotation is the largest."""
    pixels = np.random.default_rng(width * 1000 + height).integers(0, 256, (height, width, 4), np.uint8)
    pixels[..., 3] = 252 + pixels[..., 3] % 4
    return _saved(Image.fromarray(pixels).convert(mode), kind, lossless)


@cache
def one_colour(side: int) -> bytes:
    """A picture of one colour, which takes few bytes however large it is."""
    return _saved(Image.new("RGBA", (side, side), (1, 2, 3, 255)), "WEBP", True)


def _saved(image: Image.Image, kind: str, lossless: bool) -> bytes:
    out = io.BytesIO()
    image.save(out, kind, **({"lossless": lossless, "method": 0} if kind == "WEBP" else {}))
    return out.getvalue()


def parts(splats: int, degree: int, side: int = 0, **meta: Any) -> Files:
    """A folder's files; the description, parts of which may be said, comes first. With a side: of pictures of one
    colour."""
    files = saved("meta.json", splats, degree)
    if side:
        files = {name: data if name == "meta.json" else one_colour(side) for name, data in files.items()}
    return files | {"meta.json": json.dumps(json.loads(files["meta.json"]) | meta).encode()}


def archive(files: Files, method: int = zipfile.ZIP_STORED) -> bytes:
    """The files as a .sog."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as made:
        for name, content in files.items():
            made.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


def streamed(meta: Any, folders: dict[str, tuple[int, int]]) -> Files:
    """A streamed SOG folder: its description, and SOG folders of some splats and bands each."""
    files = {"lod-meta.json": json.dumps(meta).encode()}
    for folder, (splats, bands) in folders.items():
        files |= {f"{folder}/{name}": content for name, content in parts(splats, bands).items()}
    return files


def folder(rng: Random) -> Files:
    return parts(rng.choice((1, 4, 30)), rng.choice((0, 0, 1, 2, 3)))


def sog(rng: Random) -> Files:
    return {"a.sog": archive(folder(rng), rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))}


def levels(_: Random) -> Files:
    leaves = [
        {"lods": {"0": {"file": 0, "offset": 0, "count": 2}, "1": {"file": 1, "offset": 0, "count": 4}}},
        {"lods": {"0": {"file": 0, "offset": 2, "count": 3}}},
    ]
    tree = {
        "version": 1, "count": 9, "counts": [5, 4], "lodLevels": 2, "filenames": ["0/meta.json", "1/meta.json"],
        "environment": "env/meta.json",
        "tree": {"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "children": leaves},
    }  # fmt: skip
    return streamed(tree, {"0": (5, 1), "1": (4, 0), "env": (3, 0)})


def changed(files: Files, rng: Random) -> Files:
    """Of the files in an archive, or of its own records."""
    with zipfile.ZipFile(io.BytesIO(files["a.sog"])) as given:
        inner = FOLDER.changed({name: given.read(name) for name in given.namelist()}, rng)
        method = given.infolist()[0].compress_type
    if rng.random() < 0.1:
        odd = rng.choice((*TEXTS, "meta.json", "../up.webp", "/abs.webp")).encode("utf-8", "replace").decode()
        inner[odd] = rng.randbytes(40)
    out, kind = archive(inner, method), rng.randrange(16)
    if kind == 0:
        out = rng.choice((b"\0" * 7, b"#!/bin/sh\n", out)) + out
    elif kind == 1:
        out = damaged(out, rng)
    return {"a.sog": with_number(out, rng, _records(out)) if 1 < kind < 5 else out}


def _records(data: bytes) -> list[tuple[int, int]]:
    """The fields of an archive's records: sizes, methods, flags, offsets."""
    fields = []
    for signature, layout in (
        (b"PK\3\4", ((6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2))),
        (b"PK\1\2", ((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (42, 4))),
        (b"PK\5\6", ((4, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2))),
    ):
        at = data.find(signature)
        while at >= 0:
            fields += [(at + offset, size) for offset, size in layout]
            at = data.find(signature, at + 1)
    return fields


def _picture(name: str, _: bytes, rng: Random) -> bytes | None:
    """Another picture than the one that is expected: its size, its kind, or what its header says."""
    if not name.endswith(".webp"):
        return None
    kind = rng.randrange(5)
    if kind == 0:
        return picture(rng.choice((1, 2, 5, 64, 192)), rng.choice((1, 2, 3, 5)))
    if kind == 1:
        return picture(2, 2, rng.choice(("PNG", "JPEG", "GIF", "BMP")), "RGB")
    if kind == 2:
        return picture(2, 2, mode=rng.choice(("L", "RGB")), lossless=rng.random() < 0.5)
    data = bytearray(picture(rng.choice((1, 2, 6)), 2, lossless=rng.random() < 0.7))
    if kind == 3:  # a frame that says one size in front and another within
        sizes = b"".join(interesting(rng, 3).to_bytes(3, "little") for _ in range(2))
        data[12:12] = b"VP8X" + struct.pack("<IB3x", 10, rng.choice((0, 2, 16, 18))) + sizes
        data[4:8] = struct.pack("<I", len(data) - 8)
    else:
        data[21 + rng.randrange(4)] = rng.randrange(256)
    return bytes(data)


FOLDER = Rules(_HINTS, others=_picture)
