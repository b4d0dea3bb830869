"""Photographs of a scene's views: to judge pictures by. As targets of a re-fit: views/targets.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from potr_cl.formats.images import Colour
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.quality.compare import find_ground_truth, missing_photographs
from potr_cl.quality.metrics import psnr
from potr_cl.quality.photographs import read_photograph
from potr_cl.raster.rasterizer import Rasterizer


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
