"""Builds glTF files with splats (:func:`glb`, :func:`gltf`)."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import Scene

PREFIX = "KHR_gaussian_splatting:"
CODES = {"i1": 5120, "u1": 5121, "<i2": 5122, "<u2": 5123, "<f4": 5126}
#: Each attribute's array as it is stored, and whether it is normalised.
Attributes = dict[str, tuple[NDArray[Any], bool]]


def attributes(scene: Scene) -> Attributes:
    """Of a scene, all in floats."""
    values = {
        "POSITION": scene.means,
        f"{PREFIX}ROTATION": scene.quaternions[:, [1, 2, 3, 0]],
        f"{PREFIX}SCALE": np.exp(scene.log_scales),
        f"{PREFIX}OPACITY": scene.opacities[:, None],
    }
    k = 0
    for degree in range(scene.sh_degree + 1):
        for n in range(2 * degree + 1):
            values[f"{PREFIX}SH_DEGREE_{degree}_COEF_{n}"] = scene.sh[:, k]
            k += 1
    return {name: (np.ascontiguousarray(array, "<f4"), False) for name, array in values.items()}


def described(parts: Attributes, node: dict[str, Any] | None = None) -> tuple[dict[str, Any], bytes]:
    """The description of an asset with one node, and its buffer."""
    views, accessors, content = [], [], b""
    for array, normalised in parts.values():
        rows = np.ascontiguousarray(array)
        width = rows.shape[1] * rows.itemsize
        stride = -(-width // 4) * 4
        padded = np.zeros((len(rows), stride), np.uint8)
        padded[:, :width] = rows.view(np.uint8).reshape(len(rows), width)
        view = {"buffer": 0, "byteOffset": len(content), "byteLength": padded.size}
        views.append(view | ({"byteStride": stride} if stride != width else {}))
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[rows.shape[1]]
        code = CODES[rows.dtype.newbyteorder("<").str.replace("|", "")]
        accessor = {"bufferView": len(views) - 1, "componentType": code, "count": len(rows), "type": kind}
        accessors.append(accessor | ({"normalized": True} if normalised else {}))
        content += padded.tobytes()
    kind = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": {name: k for k, name in enumerate(parts)}, "mode": 0}
    primitive |= {"extensions": {"KHR_gaussian_splatting": kind}}
    return {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | (node or {})],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(content)}],
        "bufferViews": views,
        "accessors": accessors,
    }, content


def glb(description: dict[str, Any], content: bytes) -> bytes:
    """A .glb file."""
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    content += b"\0" * (-len(content) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf(description: dict[str, Any], content: bytes, uri: str | None = None) -> bytes:
    """A .gltf file, with its buffer elsewhere or in itself."""
    uri = uri or "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    return json.dumps(description | {"buffers": [{"byteLength": len(content), "uri": uri}]}).encode()
