"""Photographs of a scene's views: to judge pictures by. As targets of a re-fit: stages/refitting/targets.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from potr_cl.formats.images import Colour
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.quality.compare import find_ground_truth
from potr_cl.quality.metrics import psnr
from potr_cl.quality.photographs import read_photograph
from potr_cl.raster.rasterizer import Rasterizer


class GroundTruth:
    """The photographs of some views, read and decoded one at a time.

    Args:
        folder: holds them, named after the views.
        cameras: the views; those with a lens looking within their photographs
            (:func:`potr_cl.model.camera.within_photographs`).
        background: behind those with alpha.

    Raises:
        UsageError: there is no such folder, a view has no photograph or several, or one is not of the camera's size.
        DataError: a photograph is damaged.
    """

    def __init__(self, folder: Path, cameras: Sequence[Camera], background: Colour = (0.0, 0.0, 0.0)) -> None:
        self._paths = find_ground_truth(folder, cameras)
        self._background = background

    def picture(self, camera: Camera) -> FloatArray:
        """(H, W, 3) float32, the photograph of a view, without lens distortion.

        Raises:
            UsageError: it cannot be opened.
            DataError: it is damaged or has other than 8 bits a channel.
        """
        return read_photograph(self._paths[camera.name], camera, self._background)

    def psnr(self, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> float:
        """Mean over views of the PSNR of a scene's pictures against the photographs, in decibels.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        return float(np.mean([psnr(rasterizer.render(camera)[0], self.picture(camera)) for camera in cameras]))
