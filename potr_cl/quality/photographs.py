"""A view's photograph as its pinhole would show it (:func:`read_photograph`): lens distortion is taken out."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.images import Colour, read_ground_truth
from potr_cl.model.camera import Camera
from potr_cl.model.lens import Lens, Pinhole
from potr_cl.model.scene import FloatArray

#: Rows that are resampled at a time: the temporaries stay small.
_ROWS = 64


def read_photograph(path: Path, camera: Camera, background: Colour = (0.0, 0.0, 0.0)) -> FloatArray:
    """Read the photograph of a view.

    Args:
        path: of the image.
        camera: the view. If it has a lens, it must look at no more than the photograph shows
            (:func:`potr_cl.model.camera.within_photographs`).
        background: behind an image with alpha.

    Returns:
        (H, W, 3) float32 of the camera's size; resampled bilinearly where there is a lens.

    Raises:
        UsageError: it cannot be opened.
        DataError: it is damaged or of another size, or the view looks beyond it.
    """
    photograph = read_ground_truth(path, background)
    if camera.lens is None:
        return photograph
    if photograph.shape[:2] != (camera.lens.height, camera.lens.width):
        raise DataError(
            f"'{path}' does not have the size of its camera, {camera.lens.width} x {camera.lens.height} pixels"
        )
    view = Pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    if not _fills(camera.lens, view):
        raise DataError(f"camera '{camera.name}' looks at more than its photograph shows: give within_photographs")
    return undistorted(photograph, camera.lens, view)


def undistorted(photograph: FloatArray, lens: Lens, view: Pinhole) -> FloatArray:
    """What a pinhole view shows of a photograph that a lens has bent.

    Args:
        photograph: (H, W, 3) float32.
        lens: of the photograph.
        view: within it; beyond the border the border's pixels are repeated.

    Returns:
        (height, width, 3) float32: at each pixel's centre the bilinear mean of the four pixels around the place where
        the lens has put it.
    """
    result = np.empty((view.height, view.width, photograph.shape[2]), np.float32)
    columns, rows = _positions(lens, view)
    most = (photograph.shape[1] - 1, photograph.shape[0] - 1)
    for start in range(0, view.height, _ROWS):
        block = slice(start, start + _ROWS)
        x, y = np.clip(columns[block], 0, most[0]), np.clip(rows[block], 0, most[1])
        left, top = x.astype(np.intp), y.astype(np.intp)
        right, bottom = np.minimum(left + 1, most[0]), np.minimum(top + 1, most[1])
        x, y = (x - left)[..., None], (y - top)[..., None]
        above = photograph[top, left] * (1 - x) + photograph[top, right] * x
        below = photograph[bottom, left] * (1 - x) + photograph[bottom, right] * x
        result[block] = above * (1 - y) + below * y
    return result


@lru_cache(maxsize=2)
def _positions(lens: Lens, view: Pinhole) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(height, width) columns and rows of the photograph, 0 at the first pixel's centre; views mostly share a lens."""
    x = (np.arange(view.width) + 0.5 - view.cx) / view.fx
    y = (np.arange(view.height) + 0.5 - view.cy) / view.fy
    u, v = lens.distorted(*np.meshgrid(x, y))
    columns: NDArray[np.float32] = (u * lens.fx + lens.cx - 0.5).astype(np.float32)
    rows: NDArray[np.float32] = (v * lens.fy + lens.cy - 0.5).astype(np.float32)
    return columns, rows


@lru_cache(maxsize=64)
def _fills(lens: Lens, view: Pinhole) -> bool:
    return lens.fills(view)
