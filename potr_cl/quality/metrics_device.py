"""PSNR and SSIM of pictures that lie on a device, found there: :mod:`potr_cl.quality.metrics` in single precision.

Kernels sum squared errors and distances of SSIM from 1 over parts of the pictures (cl/quality/similarity_*.cl); the
parts are added in double precision. Against the definition PSNR is right to 1e-5 dB and SSIM to 1e-6.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics import C1, C2, WINDOW
from potr_cl.raster.rasterizer import Rasterizer

#: Values (of three a pixel) and rows that a work-item of a CPU does; pixels along a side of a GPU's tile.
_CPU_PART, _GPU_PART = (96, 32), 16
#: Views that are rendered together on a GPU, and the bytes that their pictures may take.
_MOST_VIEWS, _MOST_BYTES = 32, 1 << 28


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


class Similarity:
    """Compares pictures on one device.

    Args:
        device: that the pictures lie on.

    Raises:
        DeviceError: the kernel cannot be built.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        numbers: dict[str, float | int] = {f"WEIGHT_{k}": float(weight) for k, weight in enumerate(WINDOW)}
        if device.family == "cpu":
            numbers["LANES"] = max(device.vector_width, 8)
        self._kernel = device.shared_kernel(
            f"quality/similarity_{device.family}.cl",
            "similarity",
            [None, np.uint64, None, np.uint64, np.int32, np.int32, None, np.uint32],
            **numbers,
            C1=C1,
            C2=C2,
        )

    def __call__(self, pairs: Sequence[tuple[Picture, Picture]]) -> list[tuple[float, float]]:
        """PSNR in decibels (infinite for identical pictures) and SSIM of each pair of pictures of one size.

        Raises:
            DeviceError: the device failed, or has no room for the sums.
        """
        device = self._device
        grids = [self._grid(image) for image, _ in pairs]
        starts = np.cumsum([0, *(columns * rows for columns, rows in grids)])
        sums = device.allocate(8 * int(starts[-1]), "the pictures' similarities")
        try:
            for (image, reference), (columns, rows), start in zip(pairs, grids, starts, strict=False):
                self._kernel.set_args(
                    image.buffer,
                    image.first,
                    reference.buffer,
                    reference.first,
                    image.width,
                    image.height,
                    sums,
                    start,
                )
                side = 1 if device.family == "cpu" else _GPU_PART
                device.launch(self._kernel, (columns * side, rows * side), (side, side))
            parts = device.download(sums, (int(starts[-1]), 2), np.float32).astype(np.float64)
        finally:
            device.free(sums)
        return [
            _figures(parts[start:stop].sum(axis=0) / (3 * image.width * image.height))
            for (image, _), start, stop in zip(pairs, starts, starts[1:], strict=False)
        ]

    def _grid(self, picture: Picture) -> tuple[int, int]:
        """Parts of a picture, along a row and along a column."""
        if self._device.family == "cpu":
            return -(-3 * picture.width // _CPU_PART[0]), -(-picture.height // _CPU_PART[1])
        return -(-picture.width // _GPU_PART), -(-picture.height // _GPU_PART)


def _figures(means: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[float, float]:
    error, dissimilarity = (float(mean) for mean in means)
    return math.inf if error == 0 else -10 * math.log10(error), 1 - dissimilarity


def in_batches(device: Device, cameras: Sequence[Camera]) -> Iterator[Sequence[Camera]]:
    """Views to render and compare together: on a GPU as many as take little memory, on a CPU one."""
    most = 1 if device.family == "cpu" else _MOST_VIEWS
    room = min(_MOST_BYTES, device.info.largest_buffer, (device.info.memory - device.allocated) // 8)
    start = 0
    while start < len(cameras):
        stop, nbytes = start, 0
        while stop < len(cameras) and stop - start < most:
            nbytes += 12 * cameras[stop].width * cameras[stop].height
            if nbytes > room and stop > start:
                break
            stop += 1
        yield cameras[start:stop]
        start = stop


def place_pictures(buffer: cl.Buffer, cameras: Sequence[Camera]) -> list[Picture]:
    """The views' pictures one behind the other in a buffer."""
    pictures, first = [], 0
    for camera in cameras:
        pictures.append(Picture(buffer, first, camera.width, camera.height))
        first += camera.width * camera.height
    return pictures


@contextmanager
def rendered(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> Iterator[list[Picture]]:
    """Pictures of a scene from some views, on the device until the end.

    Raises:
        DeviceError: they do not fit the device, or it failed.
    """
    device = rasterizer.device
    buffer = device.allocate(sum(12 * camera.width * camera.height for camera in cameras), "the pictures")
    try:
        with device.errors("failed while rendering"):
            rasterizer.render_into(cameras, buffer)
        yield place_pictures(buffer, cameras)
    finally:
        device.free(buffer)
