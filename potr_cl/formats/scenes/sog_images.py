"""What a SOG file holds, :class:`SogImages`, and how it is written: bundled in an archive, or as files of a folder."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.host.atomic_write import replacing
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray

U8 = NDArray[np.uint8]

#: Of the scene, in an archive or a folder.
DESCRIPTION = "meta.json"
#: The "model" of a scene that was trained with antialiasing; one without has none.
ANTIALIASED = "antialiased"
#: Numbers in a codebook, and most entries of a palette of SH coefficients; these stand 64 in a row.
CODEBOOK, PALETTE, PALETTE_COLUMNS = 256, 1 << 16, 64
#: The alpha of a quaternion's pixel: this and the number of its largest part, of w, x, y, z.
FIRST_TAG = 252

#: Width and height that a WebP image can have.
_LARGEST_SIDE = 16383
#: Sides are multiples of this, as in the files of other tools: the compressor of textures on a GPU wants blocks.
_SIDE = 4
#: An archive's members have a time; so that a scene has the same bytes whenever it is written, the first there is.
_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Palette:
    """The SH coefficients from degree 1 on, of which splats have one of some sets.

    Attributes:
        book: (up to 256,) float32, ascending: the values of coefficients.
        entries: (K, M − 1, 3) uint8, the number in the book of each coefficient; K is 65536 at most.
        labels: (N,) uint16, the entry of each splat.
    """

    book: FloatArray
    entries: U8
    labels: NDArray[np.uint16]


@dataclass(frozen=True)
class SogImages:
    """A scene in the numbers that a SOG file holds, in the order of the file.

    Attributes:
        least, most: (3,) float32: of the logarithms of positions, sign(x) log(1 + |x|), what steps 0 and 65535 mean.
        steps: (N, 3) uint16, positions between them.
        quaternions: (N, 4) uint8: three parts, and which one is left out.
        scale_book: (up to 256,) float32, ascending: logarithms of standard deviations.
        scales: (N, 3) uint8, numbers in that book.
        colour_book: (up to 256,) float32, ascending: SH coefficients of degree 0.
        colours: (N, 4) uint8, numbers in that book of R, G, B, and the opacity in steps of 1/255.
        palette: None for a scene of SH degree 0.
        antialiased: as of the scene.
    """

    least: FloatArray
    most: FloatArray
    steps: NDArray[np.uint16]
    quaternions: U8
    scale_book: FloatArray
    scales: U8
    colour_book: FloatArray
    colours: U8
    palette: Palette | None
    antialiased: bool

    def __len__(self) -> int:
        return len(self.steps)


def bundle(images: SogImages) -> bytes:
    """The bytes of a .sog file. Raises DataError if there are more splats than an image has pixels."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members(images):
            entry = zipfile.ZipInfo(name, _TIME)
            # Images are compressed already. So is the description in no other tool's file, but all readers take it.
            entry.compress_type = zipfile.ZIP_DEFLATED if name == DESCRIPTION else zipfile.ZIP_STORED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def write_folder(path: str | os.PathLike[str], images: SogImages) -> None:
    """Write the files of a folder, which must exist; the description gets its name when all others have theirs.

    Args:
        path: of the description.
        images: to be written.

    Raises:
        UsageError: a file cannot be written there.
        DataError: there are more splats than an image has pixels.
        PotrError: the system failed to write.
    """
    contents = dict(members(images))
    with contextlib.ExitStack() as files:
        description: BinaryIO = files.enter_context(replacing(path))  # the last to be closed
        description.write(contents.pop(DESCRIPTION))
        for name, content in contents.items():
            files.enter_context(replacing(Path(path).parent / name)).write(content)


def members(images: SogImages) -> Iterator[tuple[str, bytes]]:
    """Names and contents of all files, the description last.

    Raises:
        DataError: there are more splats than an image has pixels.
    """
    width, height = _size(len(images))

    pictures: list[tuple[str, U8, int, int]] = [
        ("means_l.webp", (images.steps & 0xFF).astype(np.uint8), width, height),
        ("means_u.webp", (images.steps >> 8).astype(np.uint8), width, height),
        ("quats.webp", images.quaternions, width, height),
        ("scales.webp", images.scales, width, height),
        ("sh0.webp", images.colours, width, height),
    ]
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "potr_cl"},
        "count": len(images),
        "means": {"mins": _numbers(images.least), "maxs": _numbers(images.most)},
        "scales": {"codebook": _book(images.scale_book)},
        "quats": {},
        "sh0": {"codebook": _book(images.colour_book)},
    }
    named = {"means": ["means_l.webp", "means_u.webp"], "scales": ["scales.webp"]}
    named |= {"quats": ["quats.webp"], "sh0": ["sh0.webp"]}
    if images.antialiased:
        meta["model"] = ANTIALIASED
    palette = images.palette
    if palette is not None:
        entries, coefficients, _ = palette.entries.shape
        rows = -(-entries // PALETTE_COLUMNS)
        columns = PALETTE_COLUMNS * coefficients
        pictures.append(("shN_centroids.webp", palette.entries.reshape(-1, 3), columns, rows))
        labels = np.zeros((len(images), 3), np.uint8)
        labels[:, 0], labels[:, 1] = palette.labels & 0xFF, palette.labels >> 8
        pictures.append(("shN_labels.webp", labels, width, height))
        bands = math.isqrt(coefficients + 1) - 1
        meta["shN"] = {"count": entries, "bands": bands, "codebook": _book(palette.book)}
        named["shN"] = ["shN_centroids.webp", "shN_labels.webp"]
    for name, files in named.items():
        meta[name]["files"] = files
    with thread_pool() as pool:
        yield from pool.map(_image, pictures)
    yield DESCRIPTION, json.dumps(meta, separators=(",", ":")).encode()


def _image(picture: tuple[str, U8, int, int]) -> tuple[str, bytes]:
    """The name and the bytes of a picture: its pixels one after another, its columns and rows."""
    name, pixels, columns, rows = picture
    # The last pixel goes on to the end of the image: what is repeated takes the fewest bytes.
    padded = np.empty((columns * rows, pixels.shape[1]), np.uint8)
    padded[: len(pixels)], padded[len(pixels) :] = pixels, pixels[-1]
    return name, _webp(padded.reshape(rows, columns, -1))


def _size(splats: int) -> tuple[int, int]:
    """Width and height of an image with a pixel for each splat. Raises DataError if there is none."""
    root = math.isqrt(splats - 1) + 1
    width = min(-(-root // _SIDE), _LARGEST_SIDE // _SIDE) * _SIDE
    rows = -(-splats // width)
    height = -(-rows // _SIDE) * _SIDE
    if height > _LARGEST_SIDE:
        raise DataError(f"a SOG file cannot hold {splats} splats: WebP images have {_LARGEST_SIDE} rows at most")
    return width, height


def _webp(pixels: U8) -> bytes:
    """A lossless WebP image of (rows, columns, 3 or 4)."""
    from PIL import Image  # imported on use: few write this format

    buffer = io.BytesIO()
    # Noise is not packed better by more effort: it takes up to 400 times as long, and a few percent more bytes.
    # Pixels of alpha 0 have colours too.
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, quality=50, method=2, exact=True)
    return buffer.getvalue()


def _book(values: FloatArray) -> list[float]:
    """A codebook of as many numbers as readers want; the last one is repeated."""
    numbers = _numbers(values)
    return numbers + numbers[-1:] * (CODEBOOK - len(numbers))


def _numbers(values: FloatArray) -> list[float]:
    """The shortest numbers that are read as these in single precision."""
    return [float(str(np.float32(value))) for value in values]
