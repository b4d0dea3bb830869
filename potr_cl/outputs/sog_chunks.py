"""Some splats of a .sog file as a SOG folder of their own (:class:`SogChunks`): nothing is rounded anew."""

from __future__ import annotations

import copy
import io
import json
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats.scenes.sog_images import DESCRIPTION, PALETTE_COLUMNS, U8, image_file, size_of_images

_CENTROIDS, _LABELS = "shN_centroids.webp", "shN_labels.webp"


class SogChunks:
    """A .sog file that this package has written, unpacked.

    Args:
        data: the file.
    """

    def __init__(self, data: bytes) -> None:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            self._meta: dict[str, Any] = json.loads(archive.read(DESCRIPTION))
            names = [name for name in archive.namelist() if name != DESCRIPTION]
            images = {name: _pixels(archive.read(name)) for name in names}
        count, self._entries = self._meta["count"], None
        if _CENTROIDS in images:
            coefficients = images[_CENTROIDS].shape[1] // PALETTE_COLUMNS
            self._entries = images.pop(_CENTROIDS).reshape(-1, coefficients, 3)
        self._splats = {name: image.reshape(-1, image.shape[2])[:count] for name, image in images.items()}

    def folder(self, rows: NDArray[np.int64]) -> dict[str, bytes]:
        """The files of a folder with some of the splats, by name.

        Args:
            rows: (n,) the numbers of the splats in the file, n >= 1, in the order that they are to have.
        """
        meta = copy.deepcopy(self._meta)
        meta["count"] = len(rows)
        width, height = size_of_images(len(rows))
        splats = {name: pixels[rows] for name, pixels in self._splats.items()}
        files: dict[str, bytes] = {}
        if self._entries is not None:
            used, labels = np.unique(_labels(splats[_LABELS]), return_inverse=True)
            splats[_LABELS][:, 0], splats[_LABELS][:, 1] = labels & 0xFF, labels >> 8
            entries = self._entries[used]
            meta["shN"]["count"] = len(used)
            size = (PALETTE_COLUMNS * entries.shape[1], -(-len(used) // PALETTE_COLUMNS))
            files.update([image_file((_CENTROIDS, entries.reshape(-1, 3), *size))])
        files.update(image_file((name, pixels, width, height)) for name, pixels in splats.items())
        return {**dict(sorted(files.items())), DESCRIPTION: json.dumps(meta, separators=(",", ":")).encode()}


def _labels(pixels: U8) -> NDArray[np.int64]:
    return pixels[:, 0].astype(np.int64) | (pixels[:, 1].astype(np.int64) << 8)


def _pixels(data: bytes) -> U8:
    """(rows, columns, 3 or 4) of a WebP image; that of opacities alone has four channels, and rotations."""
    from PIL import Image  # imported on use: few write this format

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image)
