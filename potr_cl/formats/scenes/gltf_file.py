"""A glTF 2.0 asset (:class:`Asset`), .glb or .gltf: its description, its buffers, its accessors as float32.

Nothing is trusted: an accessor is only looked into once it lies within its view, the view within its buffer, and the
buffer within its file.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.scenes.scene_files import opened, related, shown
from potr_cl.model.scene import FloatArray

_MAGIC = b"glTF"
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_JSON, _BINARY = b"JSON", b"BIN\0"
#: Beyond what scenes need: an index that is larger is damage.
_MOST = 2**31
#: Numbers by their codes, and what a normalised one is divided by.
_COMPONENTS: dict[int, tuple[str, float]] = {
    5120: ("i1", 127.0),
    5121: ("u1", 255.0),
    5122: ("<i2", 32767.0),
    5123: ("<u2", 65535.0),
    5126: ("<f4", 0.0),
}
_PARTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


class Asset:
    """An asset whose parts are checked when they are asked for.

    Args:
        path: of the file. The buffers of a .gltf may be in files beside it.

    Attributes:
        description: the JSON object.
        size: bytes of the file and of all the files that were read for it.

    Raises:
        UsageError: there is no such file.
        DataError: it is no glTF 2.0 asset.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path
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
        return list(dict.fromkeys([Path(self._path), *beside]))

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """One of the objects of a list of the description.

        Raises:
            DataError: there is no such object.
        """
        entries = self.description.get(kind)
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise self.damaged(f"there is no {shown(index)} among its {kind}")
        if not isinstance(entries[index], dict):
            raise self.damaged(f"{kind} {index} is not an object")
        found: dict[str, Any] = entries[index]
        return found

    def count(self, accessor: Any) -> int:
        """How many values an accessor says that it has.

        Raises:
            DataError: no number that can be.
        """
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
                f"'{self._path}' is packed with {shown(packed[0])}, which cannot be read: export it uncompressed"
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
        """The bytes of a view.

        Raises:
            DataError: there is no such view, or it does not lie within the file.
        """
        return self._view(self.entry("bufferViews", view))

    def whole(self, entry: dict[str, Any], key: str, default: int | None = None, least: int = 0) -> int:
        """A whole number of the description.

        Raises:
            DataError: it is none, or too small or large.
        """
        value = entry.get(key, default)
        if type(value) is not int or not least <= value < _MOST:
            raise self.damaged(f"an impossible '{key}': {shown(value)}")
        return value

    def damaged(self, what: str) -> DataError:
        """The error for a file that breaks the format's rules."""
        return DataError(f"'{self._path}' is damaged: {what}")

    def _chunks(self, content: bytes) -> tuple[memoryview, memoryview | None]:
        """The description, and the buffer that a .glb has in itself."""
        if len(content) < _HEADER.size + _CHUNK.size:
            raise self.damaged("it is truncated")
        _, version, length = _HEADER.unpack_from(content)
        if version != 2:
            raise DataError(f"'{self._path}' is a GLB file of version {version}, only 2 can be read")
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
            raise UsageError(f"'{self._path}' has a buffer elsewhere, {shown(uri)}: download it, and name it there")
        return related(Path(self._path), urllib.parse.unquote(uri))

    def _beside(self, uri: str) -> memoryview:
        file = self._where(uri)
        if file not in self._files:
            with opened(file) as (stream, size):
                self._files[file] = memoryview(stream.read())
            self.size += size
        return self._files[file]
