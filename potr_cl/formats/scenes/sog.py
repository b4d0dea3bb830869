"""Scenes as SOG (PlayCanvas), version 2: a description and lossless WebP images, in a zip archive (.sog) or a folder.

A pixel is a splat. What is checked is what is used: a folder's files are read once.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.scene_files import (
    byte_logits,
    check_splats,
    cleaned,
    file_in_folder,
    opened,
    reading,
    related,
    tell_of_low_pass,
    unit_quaternions,
)
from potr_cl.formats.scenes.sog_images import (
    ANTIALIASED,
    CODEBOOK,
    DESCRIPTION,
    PALETTE,
    PALETTE_COLUMNS,
    U8,
    bundle,
    write_folder,
)
from potr_cl.formats.scenes.sog_values import areas, in_order, palette_of, quantised, unpacked_means, unpacked_rotations
from potr_cl.host.atomic_write import replacing
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene

#: What is packed in a SOG file is compressed already; only its description shrinks.
_DESCRIPTION_BYTES = 1 << 22
#: Others take memory that an archive's size does not bound.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """The scene of a .sog, of the file meta.json in a folder, or of that folder.

    See :class:`potr_cl.formats.declaration.SceneLoader`.
    """
    folder = file_in_folder(path, DESCRIPTION)
    if folder is not None:
        description, images = read_folder(folder)
        with reading(path):
            return cleaned(
                path, Sog(path, description, images.__getitem__, folder_bytes(description, images), trust).scene()
            )
    with opened(path) as (file, size):
        archive = _opened_archive(path, file, size)
        scene = Sog(path, archive.read(DESCRIPTION), archive.read, size, trust).scene()
    return cleaned(path, scene)


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene as SOG, version 2, as fine as the format is: an archive, or the files of a folder.

    SH coefficients come from a palette of 65536 sets at most. If the scene has more, they are found by clustering on
    the OpenCL device that should be fastest.

    Args:
        path: of the .sog, or of the file meta.json in a folder that exists.
        scene: as of :class:`potr_cl.formats.declaration.SceneSaver`, which tells what is raised; and:

    Raises:
        DeviceError: no device finds the palette.
    """
    tell_of_low_pass(path, scene)
    scene = in_order(unit_quaternions(scene))
    images = quantised(scene, palette_of(scene), areas(scene))
    if Path(path).name.lower() == DESCRIPTION:
        write_folder(path, images)
        return
    with replacing(path) as file:
        file.write(bundle(images))


def files(path: Path) -> list[Path]:
    """A packed file; of a folder the description and the images that it names.

    Raises:
        UsageError: the description cannot be opened.
        DataError: it is damaged, or names a file outside of the folder.
    """
    description = file_in_folder(path, DESCRIPTION)
    if description is None:
        return [path]
    return [description, *(related(description, name) for name in _described(description)[1])]


FORMAT = SceneFormat(
    name="SOG",
    suffixes=(".sog",),
    names=(DESCRIPTION,),
    files=files,
    note="of PlayCanvas; version 2, packed (`.sog`) or as a folder (`meta.json`)",
    load=load,
    save=save,
    starts=(b"PK\x03\x04",),
    packed=True,
)


def read_folder(path: Path) -> tuple[bytes, dict[str, bytes]]:
    """The description of a SOG folder, at ``path``, and the images that it names, each read once.

    Raises:
        UsageError: one of the files cannot be opened.
        DataError: the description is damaged, or names a file outside of the folder.
    """
    description, names = _described(path)
    images = {}
    for name in names:
        with opened(related(path, name)) as (file, _):
            images[name] = file.read()
    return description, images


def folder_bytes(description: bytes, images: Mapping[str, bytes]) -> int:
    """Of all files of a SOG folder that were read."""
    return len(description) + sum(map(len, images.values()))


def _described(path: Path) -> tuple[bytes, list[str]]:
    """The bytes of a description, and the names of images in it."""
    with opened(path) as (file, size):
        if size > _DESCRIPTION_BYTES:
            raise DataError(f"'{path}' is no description of a SOG scene: it has {size} bytes")
        content: bytes = file.read()
        return content, _names_of_images(json.loads(content))


def _names_of_images(meta: Any) -> list[str]:
    """The names in a description, each once; what is none of names is left for whoever looks for the image."""
    parts = meta.values() if isinstance(meta, dict) else ()
    lists = [part.get("files") for part in parts if isinstance(part, dict)]
    names = [name for names in lists if isinstance(names, list) for name in names[:2] if isinstance(name, str)]
    return list(dict.fromkeys(names))


def _opened_archive(path: str | os.PathLike[str], file: BinaryIO, size: int) -> zipfile.ZipFile:
    archive = zipfile.ZipFile(file)
    entries = archive.infolist()
    if sum(entry.file_size for entry in entries) > 2 * size + _DESCRIPTION_BYTES:
        raise DataError(f"'{path}' is damaged: it would unpack to far more than its size")
    if any(entry.compress_size > size for entry in entries):  # room would be made for them
        raise DataError(f"'{path}' is damaged: its contents are said to be larger than itself")
    if any(entry.compress_type not in _METHODS for entry in entries):
        raise DataError(f"'{path}' is damaged: it is packed in a way that no SOG file is")
    return archive


class Sog:
    """A SOG scene, of whose parts nothing is trusted.

    Args:
        path: for messages.
        description: the bytes of meta.json.
        read: gives an image by the name that the description has for it.
        size: bytes of all of them.
        trust: whether there may be more splats than a real scene has in so many bytes.

    Attributes:
        count: of splats, as described.
    """

    def __init__(
        self, path: str | os.PathLike[str], description: bytes, read: Callable[[str], bytes], size: int, trust: bool
    ) -> None:
        self._path, self._read = path, read
        meta = json.loads(description)
        if not isinstance(meta, dict) or not {"version", "means"} & set(meta):
            raise DataError(f"'{path}' is no description of a SOG scene")
        if meta.get("version") != 2:
            version = meta.get("version", 1)
            said = version if type(version) is int and abs(version) < 1000 else "unknown"
            raise DataError(
                f"'{path}' is a SOG file of version {said}, only 2 can be read: convert it with splat-transform"
            )
        self._meta = meta
        self.count = _whole(meta["count"])
        if not 0 < self.count < 2**31:
            raise self._damaged(f"a count of {_said(meta['count'])} splats")
        check_splats(path, self.count, size, trust)

    def scene(self) -> Scene:
        """The values of all pixels, block by block, an image after another."""
        count = self.count
        coefficients = 1
        if "shN" in self._meta:
            bands = _whole(self._meta["shN"]["bands"])
            if not 1 <= bands < len(SH_COEFFICIENTS):
                raise self._damaged(f"'shN' has {_said(self._meta['shN']['bands'])} bands")
            coefficients = SH_COEFFICIENTS[bands]
        for name, images in (("means", 2), ("quats", 1), ("scales", 1), ("sh0", 1)):
            for index in range(images):
                self._check_pixels(name, index)
        scene = Scene.blank(count, coefficients, by_splat=True)
        self._fill_means(scene.means)
        self._fill_shapes(scene)
        self._fill_colours(scene)
        if coefficients > 1:
            self._fill_rest(scene.sh[:, 1:])
        return scene.rendered(self._meta.get("model") == ANTIALIASED)

    def _fill_means(self, means: FloatArray) -> None:
        low, high = self._pixels("means", 0), self._pixels("means", 1)
        least, most = (np.array(self._numbers("means", key, 3), np.float32) for key in ("mins", "maxs"))

        def fill(block: slice) -> None:
            steps = low[block, :3] | high[block, :3].astype(np.uint16) << np.uint16(8)
            with np.errstate(over="ignore"):  # such a splat is dropped
                means[block] = unpacked_means(steps, least, most)

        self._in_blocks(fill)

    def _fill_shapes(self, scene: Scene) -> None:
        quaternions, scales = self._pixels("quats", 0), self._pixels("scales", 0)
        book = self._codebook("scales")

        def fill(block: slice) -> None:
            scene.quaternions[block] = unpacked_rotations(quaternions[block])
            scene.log_scales[block] = book.take(scales[block, :3])

        self._in_blocks(fill)

    def _fill_colours(self, scene: Scene) -> None:
        colours, book, logits = self._pixels("sh0", 0), self._codebook("sh0"), byte_logits()

        def fill(block: slice) -> None:
            scene.sh[block, 0] = book.take(colours[block, :3])
            scene.opacity_logits[block] = logits.take(colours[block, 3])

        self._in_blocks(fill)

    def _fill_rest(self, rest: FloatArray) -> None:
        part, coefficients = self._meta["shN"], rest.shape[1]
        entries = _whole(part["count"])
        if not 0 < entries <= PALETTE:
            raise self._damaged(f"'shN' has {_said(part['count'])} entries")
        width, height = self._size("shN", 0)
        if width != PALETTE_COLUMNS * coefficients or not entries <= PALETTE_COLUMNS * height <= 2 * PALETTE:
            raise self._damaged(f"a palette of {width} x {height} pixels for {entries} entries")
        self._check_pixels("shN", 1)
        palette = self._pixels("shN", 0)[:, :3].reshape(-1, coefficients, 3)
        values = np.zeros((entries + 1, coefficients, 3), np.float32)
        values[:entries] = self._codebook("shN").take(palette[:entries])
        labels = self._pixels("shN", 1)

        def fill(block: slice) -> None:
            index = labels[block, 0] | labels[block, 1].astype(np.intp) << 8
            # Beyond the palette stands nothing: colours that do not change.
            rest[block] = values.take(np.minimum(index, entries), axis=0)

        self._in_blocks(fill)

    def _in_blocks(self, fill: Callable[[slice], None]) -> None:
        """Call a function with each block of splats, in several threads."""
        blocks = [slice(start, min(start + _BLOCK, self.count)) for start in range(0, self.count, _BLOCK)]
        with thread_pool() as pool:
            list(pool.map(fill, blocks))

    def _codebook(self, name: str) -> FloatArray:
        return np.array(self._numbers(name, "codebook", CODEBOOK), np.float32)

    def _numbers(self, name: str, key: str, length: int) -> list[float]:
        numbers = self._meta[name][key]
        if (
            not isinstance(numbers, list)
            or len(numbers) != length
            or not all(type(v) in (int, float) and math.isfinite(v) and abs(v) < 1e38 for v in numbers)
        ):
            raise self._damaged(f"the {key} of '{name}' are not {length} numbers")
        return numbers

    def _check_pixels(self, name: str, index: int) -> None:
        """That an image has a pixel for each splat and few more, before any is unpacked."""
        width, height = self._size(name, index)
        if not self.count <= width * height <= 2 * self.count + 2**16:
            what = "labels" if name == "shN" else "pixels"
            raise self._damaged(f"'{name}' has {width} x {height} {what} for {self.count} splats")

    def _size(self, name: str, index: int) -> tuple[int, int]:
        size = webp_size(self._stored(name, index))
        if size is None:
            raise self._damaged(f"an image of '{name}' is no WebP image")
        return size

    def _pixels(self, name: str, index: int) -> U8:
        """(pixels, 4) R, G, B, A of an image whose size was checked."""
        from potr_cl.formats.images import opened_image  # imported on use: few read this format

        stored = self._stored(name, index)
        with opened_image(io.BytesIO(stored), ("WEBP",)) as image:
            if image.size != webp_size(stored):
                raise self._damaged(f"an image of '{name}' has two sizes")
            pixels: U8 = np.asarray(image.convert("RGBA")).reshape(-1, 4)
            return pixels

    def _stored(self, name: str, index: int) -> bytes:
        return self._read(self._meta[name]["files"][index])

    def _damaged(self, what: str) -> DataError:
        return DataError(f"'{self._path}' is damaged: {what}")


def webp_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a WebP file begins with, for which Pillow would take memory; None if it is none."""
    head, kind = data[:30], data[12:16]
    if len(head) < 30 or head[:4] != b"RIFF" or head[8:12] != b"WEBP":
        return None
    if kind == b"VP8L":
        bits = int.from_bytes(head[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return int.from_bytes(head[24:27], "little") + 1, int.from_bytes(head[27:30], "little") + 1
    if kind == b"VP8 ":
        return int.from_bytes(head[26:28], "little") & 0x3FFF, int.from_bytes(head[28:30], "little") & 0x3FFF
    return None


def _whole(value: Any) -> int:
    """A whole number of the description, −1 if it is something else."""
    return value if type(value) is int else -1


def _said(value: Any) -> str:
    """A value of the description, which may be of any kind and length, for a message."""
    return str(value) if type(value) is int and value.bit_length() <= 64 else "an impossible number of"
