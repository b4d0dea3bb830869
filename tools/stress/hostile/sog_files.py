"""Changed SOG: archives, folders, streamed folders with levels; their descriptions, and the pictures in them."""

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

from tools.stress.hostile.changes import TEXTS, Files, Rules, changed_files, damaged, interesting, with_number

_PICTURES = ("means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp")
_PALETTE = ("shN_centroids.webp", "shN_labels.webp")
_COEFFICIENTS = (0, 3, 8, 15)
_NAMES: tuple[Any, ...] = (
    ["../meta.json"] * 2,
    ["/dev/zero", "a/../../b"],
    [],
    ["meta.json"] * 2,
    list(_PICTURES[2:4]),
    "abc",
    [0, None],
)
_COUNTS = (0, 1, 2, 5, 16, 17, 64, 65537, -1, 1.0, True, None, "5", 10**9, 2**31, 2**40)
_BOUNDS: tuple[Any, ...] = (
    [],
    [0],
    [1e39] * 3,
    [800.0] * 3,
    ["1", 2, 3],
    [[1, 2, 3]] * 3,
    5,
    None,
    [float("nan")] * 3,
    [1, 2, 3, 4],
)
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


def description(splats: int, bands: int) -> dict[str, Any]:
    """What meta.json says of some splats."""
    book = [k / 64 - 2 for k in range(256)]
    meta: dict[str, Any] = {
        "version": 2, "count": splats, "antialias": False,
        "means": {"mins": [-1.0, -2.0, -3.0], "maxs": [1.0, 2.0, 3.0], "files": list(_PICTURES[:2])},
        "scales": {"codebook": book, "files": [_PICTURES[3]]}, "quats": {"files": [_PICTURES[2]]},
        "sh0": {"codebook": book, "files": [_PICTURES[4]]},
    }  # fmt: skip
    if bands:
        meta["shN"] = {"count": 5, "bands": bands, "codebook": book, "files": list(_PALETTE)}
    return meta


def parts(splats: int, bands: int) -> Files:
    """A folder's files; the description comes first."""
    side = int(np.ceil(np.sqrt(splats)))
    files = {"meta.json": json.dumps(description(splats, bands)).encode()}
    files |= dict.fromkeys(_PICTURES, picture(side, side))
    if bands:
        files |= {_PALETTE[0]: picture(64 * _COEFFICIENTS[bands], 1), _PALETTE[1]: picture(side, side, mode="RGB")}
    return files


def equal_splats(side: int, splats: int) -> Files:
    """A folder whose pictures have one colour."""
    return parts(4, 0) | dict.fromkeys(_PICTURES, one_colour(side)) | {
        "meta.json": json.dumps(description(splats, 0)).encode()
    }  # fmt: skip


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


def folder_originals() -> list[Files]:
    """Good folders of every SH degree."""
    return [parts(5, bands) for bands in range(4)]


def originals() -> list[bytes]:
    """Good files of every SH degree."""
    return list(map(archive, folder_originals()))


def level_originals() -> list[Files]:
    """A good streamed SOG folder."""
    leaves = [
        {"lods": {"0": {"file": 0, "offset": 0, "count": 2}, "1": {"file": 1, "offset": 0, "count": 4}}},
        {"lods": {"0": {"file": 0, "offset": 2, "count": 3}}},
    ]
    tree = {
        "version": 1, "count": 9, "counts": [5, 4], "lodLevels": 2, "filenames": ["0/meta.json", "1/meta.json"],
        "environment": "env/meta.json",
        "tree": {"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "children": leaves},
    }  # fmt: skip
    return [streamed(tree, {"0": (5, 1), "1": (4, 0), "env": (3, 0)})]


def changed_folder(rng: Random) -> Files:
    """A small folder, changed."""
    return changed_files(parts(rng.choice((1, 4, 30)), rng.choice((0, 0, 1, 2, 3))), rng, _RULES)


def changed_levels(rng: Random) -> Files:
    """A small streamed SOG folder, changed."""
    return changed_files(level_originals()[0], rng, _RULES)


def changed(rng: Random) -> bytes:
    """A small archive, changed: of the files in it, or its own records."""
    files = changed_folder(rng)
    if rng.random() < 0.1:
        odd = rng.choice((*TEXTS, "meta.json", "../up.webp", "/abs.webp")).encode("utf-8", "replace").decode()
        files[odd] = rng.randbytes(40)
    out = archive(files, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    kind = rng.randrange(16)
    if kind == 0:
        return rng.choice((b"\0" * 7, b"#!/bin/sh\n", out)) + out
    if kind == 1:
        return damaged(out, rng)
    return with_number(out, rng, _records(out)) if kind < 5 else out


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


_RULES = Rules(_HINTS, others=_picture)
