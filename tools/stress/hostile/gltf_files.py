"""Changed glTF files with splats: the container, the description, accessors of every kind, buffers in other files."""

from __future__ import annotations

import base64
import gzip
import json
import struct
from random import Random
from typing import Any

from tools.stress.hostile import spz_files
from tools.stress.hostile.changes import TEXTS, damaged, damaged_json, damaged_value, interesting, json_bytes

#: A file or several that belong together, by their names; the first is what is read.
Files = dict[str, bytes]

_PREFIX = "KHR_gaussian_splatting:"
_CODES = {5120: ("b", 1), 5121: ("B", 1), 5122: ("h", 2), 5123: ("H", 2), 5126: ("f", 4)}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def originals() -> list[Files]:
    """Good .glb files of every SH degree, in floats, in integers and as SPZ."""
    return [
        *({"a.glb": glb(*asset(5, degree, degree % 2 == 1, Random(degree)))} for degree in range(4)),
        {"a.glb": glb(*packed_asset(5, 1, Random(0)))},
    ]


def gltf_originals() -> list[Files]:
    """Good .gltf files with a buffer in them, and with one beside them."""
    description, content = asset(5, 1, False, Random(0))
    return [{"a.gltf": gltf(description, content, None)}, _beside(description, content)]


def changed(rng: Random) -> Files:
    """A small .glb file, changed."""
    description, content = _changed_asset(rng)
    out = glb(description, content)
    if rng.random() < 0.2:
        at = rng.choice((0, 4, 8, 12, 16))
        out = out[:at] + interesting(rng, 4).to_bytes(4, "little") + out[at + 4 :]
    return {"a.glb": damaged(out, rng) if rng.random() < 0.15 else out}


def changed_gltf(rng: Random) -> Files:
    """A small .gltf file with what belongs to it, changed."""
    description, content = _changed_asset(rng)
    if rng.random() < 0.5:
        uri = None
        if rng.random() < 0.3:
            uri = rng.choice((*TEXTS, "data:;base64,AAAA", "data:,a", "http://a/b", "a.gltf", "%2e%2e/a.bin"))
        out = gltf(description, content, uri)
        return {"a.gltf": damaged_json(out, rng) if rng.random() < 0.2 else out}
    files = _beside(description, content)
    if rng.random() < 0.2:
        files["a.bin"] = damaged(files["a.bin"], rng)
    return files


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
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1], "rotation": [0, 0, 0.6, 0.8], "scale": [2, 2, 2], "translation": [1, 2, 3]},
            {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        ],
        "meshes": [{"primitives": [primitive | {"extensions": {"KHR_gaussian_splatting": kind}}]}],
        "buffers": [{"byteLength": len(content)}],
        "bufferViews": views,
        "accessors": accessors,
    }, content


def packed_asset(count: int, degree: int, rng: Random) -> tuple[dict[str, Any], bytes]:
    """The same with its splats as SPZ."""
    description, _ = asset(count, degree, False, rng)
    raw = b"".join(spz_files.sections(2, count, degree, rng))
    content = gzip.compress(spz_files.legacy(2, count, degree, raw))
    kind = description["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    kind["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    description["buffers"] = [{"byteLength": len(content)}]
    description["bufferViews"] = [{"buffer": 0, "byteOffset": 0, "byteLength": len(content)}]
    return description, content


def glb(description: Any, content: bytes) -> bytes:
    """A .glb file."""
    text = description if isinstance(description, bytes) else json_bytes(description)
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf(description: Any, content: bytes, uri: str | None) -> bytes:
    """A .gltf file."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode() if uri is None else uri
    if isinstance(description, dict):
        description = description | {"buffers": [{"byteLength": len(content), "uri": uri}]}
    return json_bytes(description)


def _beside(description: Any, content: bytes) -> Files:
    return {"a.gltf": gltf(description, content, "a.bin"), "a.bin": content}


def _changed_asset(rng: Random) -> tuple[Any, bytes]:
    count, degree = rng.choice((1, 4, 30)), rng.choice((0, 1, 3))
    if rng.random() < 0.2:
        description, content = packed_asset(count, degree, rng)
    else:
        description, content = asset(count, degree, rng.random() < 0.4, rng)
    value: Any = description
    kind = rng.randrange(8)
    if kind == 0:
        entry = rng.choice(description["accessors"])
        entry[rng.choice(("count", "byteOffset", "componentType", "bufferView", "type", "normalized", "sparse"))] = (
            rng.choice((0, 1, 2, 5120, 5125, 10**9, -1, 2**31, 1.0, True, None, "VEC3", "VEC4", "MAT4", {}))
        )
    elif kind == 1:
        entry = rng.choice(description["bufferViews"])
        key = rng.choice(("buffer", "byteOffset", "byteLength", "byteStride", "extensions"))
        entry[key] = rng.choice((0, 1, 3, 4, 12, 255, 10**9, -4, 2**40, {}, {"EXT_meshopt_compression": {}}, None))
    elif kind == 2:
        nodes = description["nodes"]
        nodes[rng.randrange(2)][rng.choice(("children", "mesh", "rotation", "scale", "translation", "matrix"))] = (
            rng.choice(
                ([0], [1], [1, 1], 0, 9, [0, 0, 0, 0], [0, 0, 0], [1, 1, -1], [1e30] * 3, [0.0] * 16, [1, 2, 9], "a")
            )
        )
    elif kind == 3:
        attributes = description["meshes"][0]["primitives"][0]["attributes"]
        attributes[rng.choice(list(attributes))] = rng.choice((0, 1, 2, 3, 4, 99, -1, "0", None))
    elif kind == 4:
        start = 4 * rng.randrange(len(content) // 4)
        content = content[:start] + rng.choice((b"\0\0\x80\x7f", b"\0\0\xc0\x7f", b"\xff" * 4)) + content[start + 4 :]
    elif kind == 5:
        content = content[: rng.randrange(len(content) + 1)]
    elif kind == 6:
        value = damaged_value(description, rng)
    return value, content


def described_bomb(description: dict[str, Any], content: bytes) -> Files:
    """A .glb that is what its description says."""
    return {"a.glb": glb(json.dumps(description).encode(), content)}
