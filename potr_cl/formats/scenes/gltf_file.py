"""A glTF 2.0 asset: read (:class:`Asset`), .glb or .gltf, and written with KHR_gaussian_splatting (:func:`binary`,
:func:`text`).

Of what is read nothing is trusted: an accessor is only looked into once it lies within its view, the view within its
buffer, and the buffer within its file.

A .glb holds its splats as SPZ, in the extension that CesiumJS reads. A .gltf has what the ratified specification has:
attributes in float32, for SH coefficients, most of the bytes, may be nothing else. Nothing is turned: both have the
scene's axes.

Specifications: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting (ratified), and pull request
2531, KHR_gaussian_splatting_compression_spz_2.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
import urllib.parse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.scenes.scene_files import opened, related, shown
from potr_cl.model.scene import FloatArray, Scene

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = f"{EXTENSION}_compression_spz_2"
#: Colours as screens have them, and linear ones; the mode of points.
SRGB, LINEAR, POINTS = "srgb_rec709_display", "lin_rec709_display", 0
_MAGIC = b"glTF"
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_JSON, _BINARY = b"JSON", b"BIN\0"
#: Beyond what scenes need: an index that is larger is damage.
_MOST = 2**31
_BYTE, _FLOAT = 5121, 5126
#: Numbers by their codes, and what a normalised one is divided by.
_COMPONENTS: dict[int, tuple[str, float]] = {
    5120: ("i1", 127.0),
    _BYTE: ("u1", 255.0),
    5122: ("<i2", 32767.0),
    5123: ("<u2", 65535.0),
    _FLOAT: ("<f4", 0.0),
}
_PARTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


class Asset:
    """An asset whose parts are checked when they are asked for.

    Args:
        path: of the file. The buffers of a .gltf may be in files beside it.

    Attributes:
        path: as given.
        description: the JSON object.
        size: bytes of the file and of all the files that were read for it.

    Raises:
        UsageError: there is no such file.
        DataError: it is no glTF 2.0 asset.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path
        self._buffers: dict[int, memoryview] = {}
        self._files: dict[Path, memoryview] = {}
        with opened(path) as (file, self.size):
            content = file.read()
            binary = content[:4] == _MAGIC
            text, self._chunk = self._chunks(content) if binary else (memoryview(content), None)
            description = json.loads(bytes(text))
        if not isinstance(description, dict) or not isinstance(description.get("asset"), dict):
            raise DataError(f"'{path}' is no glTF file: it has no asset")
        version = description["asset"].get("version")
        if not isinstance(version, str) or not version.startswith("2."):
            raise DataError(f"'{path}' is a glTF file of version {shown(version)}, only 2 can be read")
        self.description: dict[str, Any] = description

    def files(self) -> list[Path]:
        """The file, and those beside it that its buffers are in.

        Raises:
            UsageError: a buffer is elsewhere.
            DataError: a buffer is described wrongly.
        """
        buffers = self.description.get("buffers", [])
        if not isinstance(buffers, list):
            raise self.damaged("its buffers are no list")
        uris = [self.entry("buffers", number).get("uri") for number in range(len(buffers))]
        beside = [self._where(uri) for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]
        return list(dict.fromkeys([Path(self.path), *beside]))

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """One of the objects of a list of the description. Raises DataError if there is no such object."""
        entries = self.description.get(kind)
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise self.damaged(f"there is no {shown(index)} among its {kind}")
        if not isinstance(entries[index], dict):
            raise self.damaged(f"{kind} {index} is not an object")
        found: dict[str, Any] = entries[index]
        return found

    def count(self, accessor: Any) -> int:
        """How many values an accessor says that it has. Raises DataError if it is impossible."""
        return self.whole(self.entry("accessors", accessor), "count", least=1)

    def values(self, accessor: Any, parts: int) -> FloatArray:
        """The values of an accessor.

        Args:
            accessor: its number.
            parts: numbers a value: 1, 3 or 4.

        Returns:
            (count, parts) float32; of normalised integers, 0 to 1 or -1 to 1.

        Raises:
            DataError: there is no such accessor, it has other parts, or it does not lie within the file.
        """
        entry = self.entry("accessors", accessor)
        if "sparse" in entry or "bufferView" not in entry:
            raise self.damaged(f"accessor {accessor} is sparse or empty, which splats never are")
        if entry.get("componentType") not in _COMPONENTS or entry.get("type") not in _PARTS:
            raise self.damaged(f"accessor {accessor} is of an unknown type")
        if _PARTS[entry["type"]] != parts:
            raise self.damaged(f"accessor {accessor} is of type {entry['type']}")
        kind, divisor = _COMPONENTS[entry["componentType"]]
        number = np.dtype(kind)
        view = self.entry("bufferViews", entry["bufferView"])
        packed = [name for name in view.get("extensions", {}) if "compression" in name]
        if packed:
            raise DataError(
                f"'{self.path}' is packed with {shown(packed[0])}, which cannot be read: export it uncompressed"
            )
        content = self._view(view)
        count, offset = self.whole(entry, "count", least=1), self.whole(entry, "byteOffset", 0)
        stride = self.whole(view, "byteStride", parts * number.itemsize, least=1)
        if stride < parts * number.itemsize or offset + stride * (count - 1) + parts * number.itemsize > len(content):
            raise self.damaged(f"accessor {accessor} does not lie within its buffer")
        raw = np.ndarray((count, parts), number, content, offset, (stride, number.itemsize))
        values: FloatArray = raw.astype(np.float32)
        if entry.get("normalized") is True and divisor:
            values = np.maximum(values / np.float32(divisor), np.float32(-1))
        return values

    def content(self, view: Any) -> memoryview:
        """The bytes of a view. Raises DataError if there is no such view, or it does not lie within the file."""
        return self._view(self.entry("bufferViews", view))

    def whole(self, entry: dict[str, Any], key: str, default: int | None = None, least: int = 0) -> int:
        """A whole number of the description. Raises DataError if it is none, or too small or large."""
        value = entry.get(key, default)
        if type(value) is not int or not least <= value < _MOST:
            raise self.damaged(f"an impossible '{key}': {shown(value)}")
        return value

    def damaged(self, what: str) -> DataError:
        """The error for a file that breaks the format's rules."""
        return DataError(f"'{self.path}' is damaged: {what}")

    def _chunks(self, content: bytes) -> tuple[memoryview, memoryview | None]:
        """The description, and the buffer that a .glb has in itself."""
        if len(content) < _HEADER.size + _CHUNK.size:
            raise self.damaged("it is truncated")
        _, version, length = _HEADER.unpack_from(content)
        if version != 2:
            raise DataError(f"'{self.path}' is a GLB file of version {version}, only 2 can be read")
        if length > len(content):
            raise self.damaged(f"it is truncated: its header tells of {length} bytes, it has {len(content)}")
        whole, at = memoryview(content), _HEADER.size
        chunks: list[tuple[bytes, memoryview]] = []
        while at + _CHUNK.size <= length and len(chunks) < 2:
            size, kind = _CHUNK.unpack_from(content, at)
            at += _CHUNK.size
            if at + size > length:
                raise self.damaged("it is truncated: a part of it is said to be longer than the file")
            chunks.append((kind, whole[at : at + size]))
            at += size
        if not chunks or chunks[0][0] != _JSON:
            raise self.damaged("it does not begin with a description")
        return chunks[0][1], chunks[1][1] if chunks[1:] and chunks[1][0] == _BINARY else None

    def _view(self, view: dict[str, Any]) -> memoryview:
        number = self.whole(view, "buffer")
        if number not in self._buffers:
            self._buffers[number] = self._buffer(number)
        offset, length = self.whole(view, "byteOffset", 0), self.whole(view, "byteLength", least=1)
        buffer = self._buffers[number]
        if offset + length > len(buffer):
            raise self.damaged("a view does not lie within its buffer")
        return buffer[offset : offset + length]

    def _buffer(self, number: int) -> memoryview:
        entry = self.entry("buffers", number)
        length = self.whole(entry, "byteLength", least=1)
        uri = entry.get("uri")
        if uri is None:
            if number != 0 or self._chunk is None:
                raise self.damaged(f"buffer {number} is nowhere")
            content = self._chunk
        elif not isinstance(uri, str):
            raise self.damaged(f"buffer {number} is nowhere")
        elif uri.startswith("data:"):
            content = self._inline(uri)
        else:
            content = self._beside(uri)
        if length > len(content):
            raise self.damaged(f"buffer {number} is truncated: {len(content)} bytes instead of {length}")
        return content[:length]

    def _inline(self, uri: str) -> memoryview:
        head, _, text = uri.partition(",")
        if not head.endswith(";base64"):
            raise self.damaged("a buffer in it is not written in base64")
        try:
            return memoryview(base64.b64decode(text, validate=True))
        except (binascii.Error, ValueError) as error:
            raise self.damaged(f"a buffer in it is no base64: {error}") from None

    def _where(self, uri: str) -> Path:
        if "://" in uri:
            raise UsageError(f"'{self.path}' has a buffer elsewhere, {shown(uri)}: download it, and name it there")
        return related(Path(self.path), urllib.parse.unquote(uri))

    def _beside(self, uri: str) -> memoryview:
        file = self._where(uri)
        if file not in self._files:
            with opened(file) as (stream, size):
                self._files[file] = memoryview(stream.read())
            self.size += size
        return self._files[file]


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
    length = _HEADER.size + _CHUNK.size + len(said) + _CHUNK.size + chunk
    head = _HEADER.pack(_MAGIC, 2, length) + _CHUNK.pack(len(said), _JSON)
    return [head, said, _CHUNK.pack(chunk, _BINARY), *spz, padding]


def spz_in(data: bytes) -> bytes:
    """The SPZ of a file that :func:`binary` has made."""
    (said, _) = _CHUNK.unpack_from(data, _HEADER.size)
    start = _HEADER.size + _CHUNK.size
    (view,) = json.loads(data[start : start + said])["bufferViews"]
    start += said + _CHUNK.size
    return data[start : start + view["byteLength"]]


def _accessor(scene: Scene, name: str, parts: int) -> dict[str, Any]:
    accessor: dict[str, Any] = {
        "componentType": _FLOAT,
        "count": len(scene),
        "type": next(kind for kind, each in _PARTS.items() if each == parts),
    }
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
        "colorSpace": SRGB,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    description: dict[str, Any] = {"asset": {"version": "2.0", "generator": "potr_cl"}, "extensionsUsed": [EXTENSION]}
    if packed is not None:
        kind["extensions"] = packed
        description["extensionsUsed"] += packed
        description["extensionsRequired"] = description["extensionsUsed"]
    primitive = {"attributes": places, "mode": POINTS, "extensions": {EXTENSION: kind}}
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
