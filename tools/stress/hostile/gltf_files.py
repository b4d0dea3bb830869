"""glTF files with splats, of the package's own making: small good ones, and what is worth changing in them.

The description, the accessors and the container; values in floats and as SPZ, in the file and in one beside it.
"""

from __future__ import annotations

import base64
import json
import struct
from random import Random
from typing import Any

from tools.stress.hostile.changes import TEXTS, Files, Rules, saved

_NUMBERS: tuple[Any, ...] = (0, 1, 2, 3, 4, 12, 99, 255, 10**9, -1, -4, 2**31, 2**40, 1.0, True, None, {})
_MOTIONS = ([0] * 4, [0] * 3, [1, 1, -1], [1e30] * 3, [0.0] * 16, [1, 2, 9], "a")
_HINTS = {
    **dict.fromkeys(("count", "byteOffset", "bufferView", "buffer", "byteLength", "byteStride", "mesh"), _NUMBERS),
    **dict.fromkeys(("rotation", "scale", "translation", "matrix"), _MOTIONS),
    "children": ([0], [1], [1, 1], 9), "componentType": (5120, 5121, 5122, 5123, 5125, 5126, None),
    "type": ("VEC3", "VEC4", "MAT4", None), "sparse": ({},), "normalized": (True, False, None),
    "extensions": ({"EXT_meshopt_compression": {}},),
    "uri": (*TEXTS, "data:;base64,AAAA", "data:,a", "http://a/b", "a.gltf", "%2e%2e/a.bin"),
}  # fmt: skip
#: Integers take the place of floats, whose strides stay what they were.
_INTEGERS = {"SCALAR": 5121, "VEC3": 5123, "VEC4": 5120}


def asset(splats: int, degree: int) -> tuple[dict[str, Any], bytes]:
    """The description of an asset whose splats stand in two nodes, and its buffer."""
    description = json.loads(saved("a.gltf", splats, degree)["a.gltf"])
    content = base64.b64decode(description["buffers"][0].pop("uri").partition(",")[2])
    for view, accessor in zip(description["bufferViews"], description["accessors"], strict=True):
        view["byteStride"] = view["byteLength"] // splats
        accessor |= {"byteOffset": 0, "normalized": False}
    description["nodes"] = [
        {"children": [1], "rotation": [0, 0, 0.6, 0.8], "scale": [2, 2, 2], "translation": [1, 2, 3]},
        {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
    ]
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


def _any(rng: Random) -> tuple[dict[str, Any], bytes]:
    description, content = asset(rng.choice((1, 4, 30)), rng.choice((0, 1, 3)))
    if rng.random() < 0.4:
        for accessor in description["accessors"]:
            accessor |= {"componentType": _INTEGERS[accessor["type"]], "normalized": True}
    return description, content


def binary(rng: Random) -> Files:
    if rng.random() < 0.3:
        return saved("a.glb", rng.choice((1, 4, 30)), rng.choice((0, 1, 3)))
    description, content = _any(rng)
    return {"a.glb": glb(json.dumps(description).encode(), content)}


def text(rng: Random) -> Files:
    description, content = _any(rng)
    if rng.random() < 0.5:
        return {"a.gltf": gltf(description, content, None)}
    return {"a.gltf": gltf(description, content, "a.bin"), "a.bin": content}


def changed_binary(files: Files, rng: Random) -> Files:
    """Its description and its buffer by themselves, mostly; or the container."""
    data = files["a.glb"]
    end = 20 + int.from_bytes(data[12:16], "little")
    parts = {"a.json": data[20:end], "a.bin": data[end + 8 :]}
    if rng.random() < 0.8:
        parts = TEXT.changed(parts, rng)
        data = glb(parts.get("a.json", b""), parts.get("a.bin", b""))
    return _CONTAINER.changed({"a.glb": data}, rng) if rng.random() < 0.3 else {"a.glb": data}


TEXT = Rules(_HINTS)
_CONTAINER = Rules(fields=lambda name, data: ((0, 4), (4, 4), (8, 4), (12, 4), (16, 4)))
