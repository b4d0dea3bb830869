"""Changed SOG files: the archive, its description, and the pictures in it."""

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

from tools.stress.hostile.changes import TEXTS, damaged, damaged_json, damaged_text, damaged_value, interesting
from tools.stress.hostile.changes import json_bytes as as_json

_PICTURES = ("means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp")
_PALETTE = ("shN_centroids.webp", "shN_labels.webp")
_COEFFICIENTS = (0, 3, 8, 15)


@cache
def picture(width: int, height: int, kind: str = "WEBP", mode: str = "RGBA", lossless: bool = True) -> bytes:
    """A picture of noise; opaque in the channel that says which part of a rotation is the largest."""
    rng = np.random.default_rng(width * 1000 + height)
    pixels = rng.integers(0, 256, (height, width, 4), np.uint8)
    pixels[..., 3] = 252 + pixels[..., 3] % 4
    out = io.BytesIO()
    image = Image.fromarray(pixels).convert(mode)
    if kind == "WEBP":
        image.save(out, "WEBP", lossless=lossless, method=0)
    else:
        image.save(out, kind)
    return out.getvalue()


def description(splats: int, bands: int) -> dict[str, Any]:
    """What meta.json says of some splats."""
    book = [k / 64 - 2 for k in range(256)]
    meta: dict[str, Any] = {
        "version": 2,
        "count": splats,
        "antialias": False,
        "means": {"mins": [-1.0, -2.0, -3.0], "maxs": [1.0, 2.0, 3.0], "files": list(_PICTURES[:2])},
        "scales": {"codebook": book, "files": [_PICTURES[3]]},
        "quats": {"files": [_PICTURES[2]]},
        "sh0": {"codebook": book, "files": [_PICTURES[4]]},
    }
    if bands:
        meta["shN"] = {"count": 5, "bands": bands, "codebook": book, "files": list(_PALETTE)}
    return meta


def parts(splats: int, bands: int) -> dict[str, bytes]:
    """The archive's files, by name."""
    side = int(np.ceil(np.sqrt(splats)))
    files = {"meta.json": json.dumps(description(splats, bands)).encode()}
    files |= dict.fromkeys(_PICTURES, picture(side, side))
    if bands:
        files |= {_PALETTE[0]: picture(64 * _COEFFICIENTS[bands], 1), _PALETTE[1]: picture(side, side, mode="RGB")}
    return files


@cache
def one_colour(side: int) -> bytes:
    """A picture of one colour, which takes few bytes however large it is."""
    out = io.BytesIO()
    Image.new("RGBA", (side, side), (1, 2, 3, 255)).save(out, "WEBP", lossless=True, method=0)
    return out.getvalue()


def equal_splats(side: int, splats: int) -> dict[str, bytes]:
    """The files of an archive whose pictures have one colour."""
    files = dict.fromkeys(parts(4, 0), one_colour(side))
    return files | {"meta.json": json.dumps(description(splats, 0)).encode()}


def archive(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """The files as a .sog."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as made:
        for name, content in files.items():
            made.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


def originals() -> list[bytes]:
    """Good files of every SH degree."""
    return [archive(parts(5, bands)) for bands in range(4)]


def changed(rng: Random) -> bytes:
    """A small file, changed."""
    files = dict(parts(rng.choice((1, 4, 30)), rng.choice((0, 0, 1, 2, 3))))
    for _ in range(1 + rng.choice((0, 0, 1))):
        kind = rng.randrange(8)
        name = rng.choice([each for each in files if each != "meta.json"] or ["a.webp"])
        if kind <= 2 and "meta.json" in files:
            files["meta.json"] = _description(files["meta.json"], rng)
        elif kind == 3:
            files[name] = _picture(rng)
        elif kind == 4:
            files[name] = damaged(files.get(name, b"a"), rng)
        elif kind == 5:
            del files[rng.choice(list(files))]
        elif kind == 6:
            files[rng.choice((*TEXTS, "meta.json", "../up.webp", "/abs.webp")).encode("utf-8", "replace").decode()] = (
                rng.randbytes(40)
            )
        else:
            files[name] = files.pop(rng.choice(list(files)))
        if not files:
            break
    out = archive(files, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    if rng.random() < 0.3:
        out = _container(out, rng)
    return out


def _description(data: bytes, rng: Random) -> bytes:
    if rng.random() < 0.2:
        return damaged_json(data, rng) if rng.random() < 0.5 else damaged_text(data, rng)
    try:
        meta = json.loads(data)
    except ValueError:
        return data
    if not isinstance(meta, dict):
        return data
    kind = rng.randrange(6)
    if kind == 0:
        meta["count"] = rng.choice((0, 2, 5, 16, 17, -1, 1.0, True, 2**31, 2**31 - 1, interesting(rng, 3)))
    elif kind == 1:
        meta["version"] = rng.choice((1, 2, 2.0, 3, None, "2", [2], "\x1b[2J"))
    elif kind == 2 and isinstance(meta.get("shN"), dict):
        meta["shN"]["bands"] = rng.choice((0, 1, 2, 3, 4, 1.0, True, "1"))
        meta["shN"]["count"] = rng.choice((0, 1, 64, 65, 65536, 65537, -5, 2.5, "5", True))
    elif kind == 3:
        part = meta.get(rng.choice(("means", "quats", "scales", "sh0", "shN")))
        if isinstance(part, dict) and part.get("files"):
            part["files"] = rng.choice(
                ([], ["meta.json"] * 2, list(_PICTURES[2:4]), ["../x", "/etc/passwd"], "abc", {"0": 1}, [0, 1], [None])
            )
    elif kind == 4 and isinstance(meta.get("means"), dict):
        meta["means"][rng.choice(("mins", "maxs"))] = rng.choice(
            ([], [0], [1e39] * 3, [800.0] * 3, ["1", 2, 3], [[1, 2, 3]] * 3, 5, None, [float("nan")] * 3, [1, 2, 3, 4])
        )
    else:
        meta = damaged_value(meta, rng)
    return as_json(meta)


def _picture(rng: Random) -> bytes:
    """Another picture than the one that is expected: its size, its kind, or what its header says."""
    kind = rng.randrange(6)
    if kind == 0:
        return picture(rng.choice((1, 2, 5, 64, 192)), rng.choice((1, 2, 3, 5)))
    if kind == 1:
        return picture(2, 2, rng.choice(("PNG", "JPEG", "GIF", "BMP")), "RGB")
    if kind == 2:
        return picture(2, 2, mode=rng.choice(("L", "RGB")), lossless=rng.random() < 0.5)
    data = bytearray(picture(rng.choice((1, 2, 6)), 2, lossless=rng.random() < 0.7))
    if kind == 3:  # a frame that says one size in front and another within
        extended = b"VP8X" + struct.pack("<IB3x", 10, rng.choice((0, 2, 16, 18)))
        extended += interesting(rng, 3).to_bytes(3, "little") + interesting(rng, 3).to_bytes(3, "little")
        data[12:12] = extended
        data[4:8] = struct.pack("<I", len(data) - 8)
    elif kind == 4 and bytes(data[12:16]) == b"VP8L":
        at = 21 + rng.randrange(4)
        data[at] = rng.randrange(256)
    else:
        return damaged(bytes(data), rng)
    return bytes(data)


def _container(data: bytes, rng: Random) -> bytes:
    """The archive's own records: sizes, methods, flags, offsets, names."""
    out = bytearray(data)
    kind = rng.randrange(5)
    if kind == 0:
        return damaged(data, rng)
    if kind == 1:
        return rng.choice((b"\0" * 7, b"#!/bin/sh\n", data)) + data
    at = -1
    signature, fields = rng.choice(
        (
            (b"PK\3\4", ((6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2))),
            (b"PK\1\2", ((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (42, 4))),
            (b"PK\5\6", ((4, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2))),
        )
    )
    for _ in range(rng.randrange(1, 8)):
        found = data.find(signature, at + 1)
        if found < 0:
            break
        at = found
    if at >= 0:
        offset, size = rng.choice(fields)
        value = rng.choice((interesting(rng, size), 0, 1, 8, 12, 14, 99)) % (1 << 8 * size)
        out[at + offset : at + offset + size] = value.to_bytes(size, "little")
    return bytes(out)
