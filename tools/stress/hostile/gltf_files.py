"""Changed glTF files with splats: the container, the description, accessors of every kind, buffers in other files."""

from __future__ import annotations

import base64
import gzip
import json
import struct
from random import Random
from typing import Any

from tools.stress.hostile import spz_files
from tools.stress.hostile.changes import TEXTS, Files, Rules, changed_files, damaged, damaged_json

_PREFIX = "KHR_gaussian_splatting:"
_CODES = {5120: ("b", 1), 5121: ("B", 1), 5122: ("h", 2), 5123: ("H", 2), 5126: ("f", 4)}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_NUMBERS: tuple[Any, ...] = (0, 1, 2, 3, 4, 12, 99, 255, 10**9, -1, -4, 2**31, 2**40, 1.0, True, None, {})
_MOTIONS = ([0] * 4, [0] * 3, [1, 1, -1], [1e30] * 3, [0.0] * 16, [1, 2, 9], "a")
_RULES = Rules({
    **dict.fromkeys(("count", "byteOffset", "bufferView", "buffer", "byteLength", "byteStride", "mesh"), _NUMBERS),
    **dict.fromkeys(("rotation", "scale", "translation", "matrix"), _MOTIONS),
    "children": ([0], [1], [1, 1], 9), "componentType": (5120, 5121, 5122, 5125, 5126, None),
    "type": ("VEC3", "VEC4", "MAT4", None), "sparse": ({},), "normalized": (True, False, None),
    "extensions": ({"EXT_meshopt_compression": {}},),
    "uri": (*TEXTS, "data:;base64,AAAA", "data:,a", "http://a/b", "a.gltf", "%2e%2e/a.bin"),
}, lambda name, data: () if name.endswith("gltf") else ((0, 4), (4, 4), (8, 4), (12, 4), (16, 4)))  # fmt: skip


def originals() -> list[Files]:
    """Good .glb files of every SH degree, in floats, in integers and as SPZ."""
    assets = [
        *(asset(5, degree, degree % 2 == 1, Random(degree)) for degree in range(4)),
        packed_asset(5, 1, Random(0)),
    ]
    return [{"a.glb": glb(json.dumps(description).encode(), content)} for description, content in assets]


def gltf_originals() -> list[Files]:
    """Good .gltf files with a buffer in them, and with one beside them."""
    description, content = asset(5, 1, False, Random(0))
    return [
        {"a.gltf": gltf(description, content, None)},
        {"a.gltf": gltf(description, content, "a.bin"), "a.bin": content},
    ]


def changed(rng: Random) -> Files:
    """A small .glb file, changed."""
    description, content = _any_asset(rng)
    text = json.dumps(description).encode()
    for _ in range(rng.choice((0, 1, 1, 2))):
        text = damaged_json(text, rng, _RULES.hints)
    files = {"a.glb": glb(text, content)}
    return changed_files(files, rng, _RULES) if rng.random() < 0.3 else files


def changed_gltf(rng: Random) -> Files:
    """A small .gltf file with what belongs to it, changed."""
    description, content = _any_asset(rng)
    if rng.random() < 0.5:
        return changed_files({"a.gltf": gltf(description, content, None)}, rng, _RULES)
    return changed_files({"a.gltf": gltf(description, content, "a.bin"), "a.bin": content}, rng, _RULES)


def asset(count: int, degree: int, integers: bool, rng: Random) -> tuple[dict[str, Any], bytes]:
    """The description and the buffer of an asset with some splats."""
    layout: dict[str, tuple[int, int, bool]] = {
        "POSITION": (3, 5122 if integers else 5126, integers),
        f"{_PREFIX}ROTATION": (4, 5120 if integers else 5126, integers),
        f"{_PREFIX}SCALE": (3, 5123 if integers else 5126, integers),
        f"{_PREFIX}OPACITY": (1, 5121 if integers else 5126, integers),
    }
    for k in range(degree + 1):
        layout |= {f"{_PREFIX}SH_DEGREE_{k}_COEF_{n}": (3, 5126, False) for n in range(2 * k + 1)}
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    content = b""
    for parts, code, normalized in layout.values():
        letter, size = _CODES[code]
        stride = -(-parts * size // 4) * 4
        rows = b""
        for _ in range(count):
            row = struct.pack(f"<{parts}f", *(rng.random() for _ in range(parts))) if letter == "f" else b""
            rows += (row or rng.randbytes(parts * size)).ljust(stride, b"\0")
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": len(rows), "byteStride": stride})
        accessor = {"bufferView": len(views) - 1, "byteOffset": 0, "componentType": code, "count": count}
        accessors.append(accessor | {"type": _KINDS[parts], "normalized": normalized})
        content += rows
    kind = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    primitive = {"mode": 0, "attributes": {name: k for k, name in enumerate(layout)}}
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1], "rotation": [0, 0, 0.6, 0.8], "scale": [2, 2, 2], "translation": [1, 2, 3]},
            {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        ],
        "meshes": [{"primitives": [primitive | {"extensions": {"KHR_gaussian_splatting": kind}}]}],
        "buffers": [{"byteLength": len(content)}], "bufferViews": views, "accessors": accessors,
    }, content  # fmt: skip


def packed_asset(count: int, degree: int, rng: Random) -> tuple[dict[str, Any], bytes]:
    """The same with its splats as SPZ."""
    description, _ = asset(count, degree, False, rng)
    raw = b"".join(spz_files.sections(2, count, degree, rng))
    content = gzip.compress(spz_files.legacy(2, count, degree, raw), mtime=0)
    kind = description["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    kind["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    description["buffers"] = [{"byteLength": len(content)}]
    description["bufferViews"] = [{"buffer": 0, "byteOffset": 0, "byteLength": len(content)}]
    return description, content


def glb(text: bytes, content: bytes) -> bytes:
    """A .glb file of a description and a buffer."""
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf(description: dict[str, Any], content: bytes, uri: str | None) -> bytes:
    """A .gltf file; its buffer is in it where no other place is told."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode() if uri is None else uri
    return json.dumps(description | {"buffers": [{"byteLength": len(content), "uri": uri}]}).encode()


def _any_asset(rng: Random) -> tuple[dict[str, Any], bytes]:
    count, degree = rng.choice((1, 4, 30)), rng.choice((0, 1, 3))
    made = packed_asset(count, degree, rng) if rng.random() < 0.2 else asset(count, degree, rng.random() < 0.4, rng)
    return (made[0], damaged(made[1], rng)) if rng.random() < 0.3 else made
