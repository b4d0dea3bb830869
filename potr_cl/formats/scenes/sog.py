"""Scenes as SOG files (PlayCanvas' .sog), version 2, read through the library gsply."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from typing import Any

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.gsply_arrays import EXTRA, library, to_scene
from potr_cl.formats.scenes.scene_files import file_size, reading
from potr_cl.model.scene import SH_COEFFICIENTS, Scene

#: What is packed in a SOG file is compressed already; only its description shrinks.
_DESCRIPTION_BYTES = 1 << 22
_CODEBOOK = 256
#: Most entries of a palette of SH coefficients; they stand 64 in a row.
_PALETTE, _PALETTE_COLUMNS = 1 << 16, 64


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene from a SOG file.

    Raises:
        UsageError: there is no such file, or the extra ``convert`` is not installed.
        DataError: it is damaged, or of another version.
    """
    size = file_size(path)
    gsply = library(path)
    with reading(path):
        _check(path, size)
        data = gsply.sog_reader.sogread(path)
        if data.shN is not None and data.shN.shape[1] == 0:
            data.shN = None
    return to_scene(path, data)


FORMAT = SceneFormat(
    name="SOG",
    suffixes=(".sog",),
    note="of PlayCanvas; version 2 is read",
    load=load,
    not_written="nothing here writes .sog: convert to .ply, and that with splat-transform",
    extra=EXTRA,
)


def _check(path: str | os.PathLike[str], size: int) -> None:
    """Check everything that the library believes: sizes of files and images, and what indexes what."""

    from PIL import Image  # imported on use: few read this format

    def damaged(what: str) -> DataError:
        return DataError(f"'{path}' is damaged: {what}")

    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > 2 * size + _DESCRIPTION_BYTES:
            raise damaged("it would unpack to far more than its size")
        meta = json.loads(archive.read("meta.json"))
        if meta.get("version") != 2:
            raise DataError(f"'{path}' is a SOG file of version {meta.get('version', 1)}, only 2 can be read")
        count = meta["count"]
        if type(count) is not int or not 0 < count < 2**31:
            raise damaged(f"a count of {count} splats")

        def pixels(part: dict[str, Any], index: int) -> tuple[int, int]:
            with Image.open(io.BytesIO(archive.read(part["files"][index])), formats=["WEBP"]) as image:
                return image.size

        for name, images in (("means", 2), ("quats", 1), ("scales", 1), ("sh0", 1)):
            for index in range(images):
                width, height = pixels(meta[name], index)
                if not count <= width * height <= 2 * count + 2**16:
                    raise damaged(f"'{name}' has {width} x {height} pixels for {count} splats")
        for name in ("scales", "sh0", *(["shN"] if "shN" in meta else [])):
            book = meta[name]["codebook"]
            if len(book) != _CODEBOOK or not all(type(v) in (int, float) and math.isfinite(v) for v in book):
                raise damaged(f"the codebook of '{name}' is not {_CODEBOOK} numbers")
        if "shN" in meta:
            part = meta["shN"]
            if part["bands"] not in range(1, len(SH_COEFFICIENTS)) or not 0 < part["count"] <= _PALETTE:
                raise damaged(f"'shN' has {part['bands']} bands and {part['count']} entries")
            width, height = pixels(part, 0)
            if width != _PALETTE_COLUMNS * (SH_COEFFICIENTS[part["bands"]] - 1) or not (
                part["count"] <= _PALETTE_COLUMNS * height <= 2 * _PALETTE
            ):
                raise damaged(f"a palette of {width} x {height} pixels for {part['count']} entries")
            width, height = pixels(part, 1)
            if not count <= width * height <= 2 * count + 2**16:
                raise damaged(f"'shN' has {width} x {height} labels for {count} splats")
