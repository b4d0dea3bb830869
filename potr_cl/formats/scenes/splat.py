"""Scenes as .splat files (antimatter15's viewer): 32 bytes a splat, without SH beyond the colour.

Three float32 are the centre, three the scale (not its logarithm), four bytes are red, green, blue and opacity, and
four the rotation, w first. Nothing stands before or behind the splats.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.scene_files import SH_0, byte_logits, cleaned, log_of_scales, opened
from potr_cl.model.scene import FloatArray, Scene

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])
_BYTE = np.arange(256).astype(np.float32)
#: Splats read at a time: the temporaries stay small.
_BLOCK = 1 << 16


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """The scene of a .splat file, of SH degree 0; see :class:`potr_cl.formats.declaration.SceneLoader`."""
    with opened(path) as (file, size):
        count, left = divmod(size, _ROW.itemsize)
        if left or not count:
            raise DataError(
                f"'{path}' is no .splat file, or is truncated: it has {size} bytes, and each splat takes "
                f"{_ROW.itemsize}"
            )
        scene = Scene.blank(count, 1, by_splat=True)
        for start in range(0, count, _BLOCK):
            block = slice(start, min(start + _BLOCK, count))
            content = file.read((block.stop - start) * _ROW.itemsize)
            if len(content) < (block.stop - start) * _ROW.itemsize:
                raise DataError(f"'{path}' became shorter while it was read")
            rows = np.frombuffer(content, _ROW)
            scene.means[block] = rows["mean"]
            scene.log_scales[block] = log_of_scales(rows["scale"])
            scene.quaternions[block] = _unit(rows["rotation"])
            scene.opacity_logits[block] = byte_logits().take(rows["colour"][:, 3])
            scene.sh[block, 0] = colours(rows["colour"][:, :3])
    return cleaned(path, scene)


FORMAT = SceneFormat(
    name="splat",
    suffixes=(".splat",),
    note="of antimatter15's viewer and many after it; colours without SH, scales of 0 as 1e-9 unit",
    load=load,
    not_written="nothing here writes .splat, which has no SH: .spz is smaller and keeps them",
)


def colours(stored: NDArray[np.uint8]) -> FloatArray:
    """SH coefficients of degree 0 from bytes of colours, of any shape."""
    table = ((_BYTE / np.float32(255) - np.float32(0.5)) / np.float32(SH_0)).astype(np.float32)
    return table.take(stored)


def _unit(stored: NDArray[np.uint8]) -> FloatArray:
    """Quaternions from bytes for -1 to 1. Writers round down, so 0 lies between 127 and 128."""
    parts = (_BYTE / np.float32(255) * 2 - 1).take(stored)
    unit: FloatArray = parts / np.sqrt((parts * parts).sum(axis=1, keepdims=True))
    return unit
