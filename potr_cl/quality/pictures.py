"""Pictures that lie on a device."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory


class Renderer(Protocol):
    """What renders a scene: a :class:`~potr_cl.raster.rasterizer.Rasterizer`, or a
    :class:`~potr_cl.views.pictures.SeenRasterizer`, whose attributes and methods these are.
    """

    @property
    def device(self) -> Device: ...

    @property
    def background(self) -> tuple[float, float, float]: ...

    def render_into(self, cameras: Sequence[Camera], target: cl.Buffer, start: int = 0) -> None: ...

    def render(self, camera: Camera) -> tuple[FloatArray, FloatArray]: ...

    def strips(self, camera: Camera) -> Iterator[FloatArray]: ...


@dataclass(frozen=True)
class Picture:
    """A picture on a device.

    Attributes:
        buffer: (pixels, 3) float32, colours of pictures one behind the other.
        first: the pixel that this one begins with.
        width, height: of it, in pixels.
    """

    buffer: cl.Buffer
    first: int
    width: int
    height: int

    def download(self, device: Device) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        """(H, W, 3) float32."""
        image = np.empty((self.height, self.width, 3), np.float32)
        with device.errors("failed while computing"):
            cl.enqueue_copy(device.queue, image, self.buffer, src_offset=12 * self.first, is_blocking=True)
        return image


def place_pictures(buffer: cl.Buffer, cameras: Sequence[Camera]) -> list[Picture]:
    """The views' pictures one behind the other in a buffer."""
    pictures, first = [], 0
    for camera in cameras:
        pictures.append(Picture(buffer, first, camera.width, camera.height))
        first += camera.width * camera.height
    return pictures


@contextmanager
def rendered(rasterizer: Renderer, cameras: Sequence[Camera]) -> Iterator[list[Picture]]:
    """Pictures of a scene from some views, on the device until the end.

    Raises:
        DeviceError: they do not fit the device, or it failed.
    """
    device = rasterizer.device
    with Memory(device) as memory:
        buffer = memory.allocate(sum(12 * camera.width * camera.height for camera in cameras), "the pictures")
        with device.errors("failed while rendering"):
            rasterizer.render_into(cameras, buffer)
        yield place_pictures(buffer, cameras)
