"""Scenes as glTF with KHR_gaussian_splatting: :func:`binary` (.glb) and :func:`text` (.gltf).

A .glb holds its splats as SPZ, in the extension that CesiumJS reads. A .gltf has what the ratified specification has:
attributes in float32, for SH coefficients, most of the bytes, may be nothing else. Nothing is turned: both have the
scene's axes.

Specifications: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting (ratified), and pull request
2531, KHR_gaussian_splatting_compression_spz_2.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from potr_cl.model.scene import FloatArray, Scene

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = f"{EXTENSION}_compression_spz_2"
_BYTE, _FLOAT, _POINTS = 5121, 5126, 0
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


def text(scene: Scene) -> bytes:
    """A .gltf file: text, with the values in Base64."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    parts: list[bytes] = []
    places: dict[str, int] = {}
    start = 0
    for name, values in attributes(scene).items():
        data = values.tobytes()
        accessor = _accessor(scene, name, values.shape[1] if values.ndim > 1 else 1)
        places[name] = len(accessors)
        accessors.append({"bufferView": len(views), **accessor})
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data)})
        parts.append(data)
        start += len(data)
    encoded = base64.b64encode(b"".join(parts)).decode("ascii")
    buffer = {"byteLength": start, "uri": f"data:application/octet-stream;base64,{encoded}"}
    return _description(places, accessors, views, buffer)


def binary(scene: Scene, spz: Sequence[bytes]) -> list[bytes]:
    """The bytes of a .glb file, to be written one after another.

    Args:
        scene: whose number of splats, SH degree and extent the file tells.
        spz: the same as SPZ of version 2 or 3, in pieces.
    """
    # As CesiumJS asks for them: opacity is a part of the colour, which stands for the constant coefficients.
    names = {"POSITION": 3, "COLOR_0": 4, f"{EXTENSION}:ROTATION": 4, f"{EXTENSION}:SCALE": 3}
    for degree in range(1, scene.sh_degree + 1):
        names |= {f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}": 3 for n in range(2 * degree + 1)}
    accessors = [_accessor(scene, name, parts) for name, parts in names.items()]
    nbytes = sum(map(len, spz))
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": nbytes}]
    places = {name: number for number, name in enumerate(names)}
    said = _description(places, accessors, views, {"byteLength": nbytes}, {SPZ_EXTENSION: {"bufferView": 0}})
    said += b" " * (-len(said) % 4)
    padding = b"\0" * (-nbytes % 4)
    chunk = nbytes + len(padding)
    head = struct.pack("<III", _MAGIC, 2, 12 + 8 + len(said) + 8 + chunk) + struct.pack("<II", len(said), _JSON)
    return [head, said, struct.pack("<II", chunk, _BINARY), *spz, padding]


def _accessor(scene: Scene, name: str, parts: int) -> dict[str, Any]:
    accessor: dict[str, Any] = {"componentType": _FLOAT, "count": len(scene), "type": _TYPES[parts]}
    if name == "POSITION":
        accessor |= {"min": scene.means.min(axis=0).tolist(), "max": scene.means.max(axis=0).tolist()}
    if name == "COLOR_0":
        accessor |= {"componentType": _BYTE, "normalized": True}
    return accessor


def _description(
    places: dict[str, int],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    buffer: dict[str, Any],
    packed: dict[str, Any] | None = None,
) -> bytes:
    kind: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    description: dict[str, Any] = {"asset": {"version": "2.0", "generator": "potr_cl"}, "extensionsUsed": [EXTENSION]}
    if packed is not None:
        kind["extensions"] = packed
        description["extensionsUsed"] += packed
        description["extensionsRequired"] = description["extensionsUsed"]
    primitive = {"attributes": places, "mode": _POINTS, "extensions": {EXTENSION: kind}}
    description |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [buffer],
        "bufferViews": views,
        "accessors": accessors,
    }
    return json.dumps(description, separators=(",", ":")).encode()
