"""Photographs of views: found by name, read as the view's pinhole would show them (:func:`read_photograph`), and all of
a scene's (:class:`GroundTruth`). As targets of a re-fit: views/targets.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.cameras.view_files import IMAGE_SUFFIXES, stem
from potr_cl.formats.images import Colour, image_size, read_ground_truth
from potr_cl.model.camera import Camera
from potr_cl.model.lens import Lens, Pinhole
from potr_cl.model.scene import FloatArray
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer

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


def find_ground_truth(folder: Path, cameras: Sequence[Camera]) -> dict[str, Path]:
    """The photograph of each view that has one: the image in ``folder`` that is named after it.

    Raises:
        UsageError: there is no such folder, no view has a photograph, one has several, or one is not of the camera's
            size.
        DataError: a photograph is damaged.
    """
    found: dict[str, Path] = {}
    listings: dict[Path, dict[str, list[Path]]] = {}
    for camera in cameras:
        wanted = folder / camera.name
        if wanted.parent not in listings:
            if wanted.parent != folder and not wanted.parent.is_dir():
                continue
            listings[wanted.parent] = _images_by_name(wanted.parent)
        images = listings[wanted.parent].get(stem(wanted.name), [])
        exact = [image for image in images if image.name == wanted.name]
        images = exact or images
        if not images:
            continue
        if len(images) > 1:
            names = ", ".join(image.name for image in images)
            raise UsageError(f"several photographs of view '{camera.name}' in '{wanted.parent}': {names}; keep one")
        width, height = image_size(images[0])
        if (width, height) != camera.photograph_size:
            size = " x ".join(map(str, camera.photograph_size))
            raise UsageError(
                f"'{images[0]}' is {width} x {height} pixels, view '{camera.name}' of the cameras is {size}: give "
                "photographs and cameras of the same size"
            )
        found[camera.name] = images[0]
    if cameras and not found:
        raise UsageError(
            f"the folder '{folder}' has no photograph of any of the {len(cameras)} views: photographs are named after "
            f"their views, as '{cameras[0].name}'"
        )
    return found


def missing_photographs(found: Mapping[str, Path], cameras: Sequence[Camera]) -> str | None:
    """One line that says which views have no photograph; None if each has one."""
    missing = [camera.name for camera in cameras if camera.name not in found]
    if not missing:
        return None
    which = f"view '{missing[0]}' has" if len(missing) == 1 else f"{len(missing)} views, such as '{missing[0]}', have"
    return f"{which} no photograph and {'is' if len(missing) == 1 else 'are'} left out"


def _images_by_name(folder: Path) -> dict[str, list[Path]]:
    try:
        files = sorted(folder.iterdir())
    except OSError as error:
        raise UsageError(f"cannot read the folder of photographs '{folder}': {error.strerror}") from None
    images: dict[str, list[Path]] = {}
    for file in files:
        if file.suffix.lower() in IMAGE_SUFFIXES:
            images.setdefault(stem(file.name), []).append(file)
    return images


class GroundTruth:
    """The photographs of some views, read and decoded one at a time. Views without a photograph are left out.

    Args:
        folder: holds them, named after the views.
        cameras: the views; those with a lens looking within their photographs
            (:func:`potr_cl.model.camera.within_photographs`).
        background: behind those with alpha.

    Attributes:
        missing: one line that says which views have no photograph; None if each has one.

    Raises:
        UsageError: there is no such folder, no view has a photograph, one has several, or one is not of the camera's
            size.
        DataError: a photograph is damaged.
    """

    def __init__(self, folder: Path, cameras: Sequence[Camera], background: Colour = (0.0, 0.0, 0.0)) -> None:
        self._paths = find_ground_truth(folder, cameras)
        self._background = background
        self.missing = missing_photographs(self._paths, cameras)

    def of(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Those of some views that have a photograph."""
        return [camera for camera in cameras if camera.name in self._paths]

    def picture(self, camera: Camera) -> FloatArray:
        """(H, W, 3) float32, the photograph of a view, without lens distortion.

        Raises:
            UsageError: it cannot be opened.
            DataError: it is damaged or has other than 8 bits a channel.
        """
        return read_photograph(self._paths[camera.name], camera, self._background)

    def psnr(self, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> float:
        """Mean PSNR of a scene's pictures of some views against the photographs, in decibels.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        return float(np.mean([psnr(rasterizer.render(camera)[0], self.picture(camera)) for camera in cameras]))


@dataclass(frozen=True)
class PhotographFigures:
    """What an uncompressed scene and its file come to against photographs.

    Attributes:
        views: names of the views.
        kind: "test", views that no stage has looked at, or "train".
        uncompressed, file: PSNR of each view against its photograph, decibels.
    """

    views: list[str]
    kind: str
    uncompressed: list[float]
    file: list[float]

    @property
    def means(self) -> tuple[float, float]:
        """Mean over the views, of the uncompressed scene and of the file."""
        return float(np.mean(self.uncompressed)), float(np.mean(self.file))
