"""Photographs of a scene's views: to judge pictures by, and as targets of the colours' re-fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyopencl as cl

from potr_cl.formats.images import Colour, read_ground_truth
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.compare import find_ground_truth
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer


class GroundTruth:
    """The photographs of some views, read and decoded one at a time.

    Args:
        folder: holds them, named after the views.
        cameras: the views.
        background: behind those with alpha.

    Raises:
        UsageError: there is no such folder, a view has no photograph or several, or one is not of the camera's size.
        DataError: a photograph is damaged.
    """

    def __init__(self, folder: Path, cameras: Sequence[Camera], background: Colour = (0.0, 0.0, 0.0)) -> None:
        self._paths = find_ground_truth(folder, cameras)
        self._background = background

    def picture(self, camera: Camera) -> FloatArray:
        """(H, W, 3) float32, the photograph of a view.

        Raises:
            UsageError: it cannot be opened.
            DataError: it is damaged or has other than 8 bits a channel.
        """
        return read_ground_truth(self._paths[camera.name], self._background)

    def psnr(self, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> float:
        """Mean over views of the PSNR of a scene's pictures against the photographs, in decibels.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        return float(np.mean([psnr(rasterizer.render(camera)[0], self.picture(camera)) for camera in cameras]))


class GroundTruthTargets(Owner):
    """The photographs as targets of :class:`potr_cl.stages.refitting.refit.ColourRefit`.

    Args:
        device: that the re-fit computes on.
        photographs: of all the cameras.
        cameras: the views.

    Raises:
        DeviceError: a photograph does not fit the device.
    """

    def __init__(self, device: Device, ground_truth: GroundTruth, cameras: Sequence[Camera]) -> None:
        self._device = device
        self._ground_truth = ground_truth
        self._cameras = list(cameras)
        self._buffer = device.allocate(12 * max(c.width * c.height for c in cameras), "a photograph")

    def __call__(self, number: int) -> cl.Buffer:
        picture = np.ascontiguousarray(self._ground_truth.picture(self._cameras[number]))
        with self._device.errors("failed to take a photograph"):
            cl.enqueue_copy(self._device.queue, self._buffer, picture, is_blocking=True)
        return self._buffer

    def close(self) -> None:
        self.free()

    def free(self) -> None:
        """Give the device's memory back."""
        self._device.free(self._buffer)
