"""Scenes as glTF with KHR_gaussian_splatting: :func:`pieces`.

All attributes are float32: SH coefficients, most of the bytes, may be nothing else, and not every reader takes what the
others may be. Nothing is turned: the file has the scene's axes.

Specification: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting (ratified).
"""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np

from potr_cl.model.scene import FloatArray, Scene

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _POINTS = 5126, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
#: The largest float32 below 1: an opacity of 1 has no logit.
_LARGEST_OPACITY = np.float32(1 - 2.0**-24)


def attributes(scene: Scene) -> dict[str, FloatArray]:
    """The values of a file by the names of its attributes.

    Scales are standard deviations, opacities follow the sigmoid, unit quaternions have w last.
    """
    lengths = np.linalg.norm(scene.quaternions.astype(np.float64), axis=1, keepdims=True)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-scene.opacity_logits.astype(np.float64)))
        scales = np.exp(scene.log_scales.astype(np.float64))
    values = {
        "POSITION": scene.means,
        f"{EXTENSION}:ROTATION": (scene.quaternions / lengths)[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.minimum(scales, np.finfo(np.float32).max),
        f"{EXTENSION}:OPACITY": np.minimum(opacities, _LARGEST_OPACITY),
    }
    for degree in range(scene.sh_degree + 1):
        for n in range(2 * degree + 1):
            values[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = scene.sh[:, degree * degree + n]
    return {name: np.ascontiguousarray(value, "<f4") for name, value in values.items()}


def pieces(scene: Scene, binary: bool = True) -> list[bytes]:
    """The bytes of a file, to be written one after another.

    Args:
        scene: to write.
        binary: .glb; otherwise a .gltf, which is text with the values in Base64, a third larger.
    """
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    parts: list[bytes] = []
    places: dict[str, int] = {}
    start = 0
    for name, values in attributes(scene).items():
        data = values.tobytes()
        accessor = {
            "bufferView": len(views),
            "componentType": _FLOAT,
            "count": len(scene),
            "type": _TYPES[values.shape[1] if values.ndim > 1 else 1],
        }
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        places[name] = len(accessors)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data)})
        accessors.append(accessor)
        parts.append(data)
        start += len(data)
    kind = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"attributes": places, "mode": _POINTS, "extensions": {EXTENSION: kind}}
    description: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "potr_cl"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    if not binary:
        text = base64.b64encode(b"".join(parts)).decode("ascii")
        description["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{text}"
        return [json.dumps(description, separators=(",", ":")).encode()]
    said = json.dumps(description, separators=(",", ":")).encode()
    said += b" " * (-len(said) % 4)
    head = struct.pack("<III", _MAGIC, 2, 12 + 8 + len(said) + 8 + start) + struct.pack("<II", len(said), _JSON)
    return [head, said, struct.pack("<II", start, _BINARY), *parts]
