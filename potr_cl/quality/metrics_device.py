"""PSNR and SSIM of pictures that lie on a device, found there: :mod:`potr_cl.quality.metrics` in single precision.

Kernels sum squared errors and distances of SSIM from 1 over parts of the pictures (cl/quality/similarity_*.cl); the
parts are added in double precision. Against the definition PSNR is right to 1e-5 dB and SSIM to 1e-6.
"""

from __future__ import annotations

import math
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
from potr_cl.quality.metrics import C1, C2, WINDOW


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


#: Pixels along a side of a GPU's work-group: GROUP in cl/quality/similarity_gpu.cl.
_TILE = 16
#: Values (of three a pixel) and rows that a work-item does on a CPU.
_VALUES, _ROWS = 96, 32
#: Fewest values that the kernel takes at a time.
_LEAST_LANES = 8
#: Bytes that the pictures of views that are rendered together may take.
_MOST_BYTES = 1 << 28


class Similarity:
    """Compares pictures on one device.

    Args:
        device: that the pictures lie on.

    Raises:
        DeviceError: the kernel cannot be built.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._on_gpu = device.family == "gpu"
        sizes = {"LANES": max(device.vector_width, _LEAST_LANES), "BLOCK": _VALUES, "ROWS": _ROWS}
        macros: dict[str, float | int] = {f"WEIGHT_{k}": float(weight) for k, weight in enumerate(WINDOW)}
        macros |= {"C1": C1, "C2": C2} | ({} if self._on_gpu else sizes)
        self._kernel = device.shared_kernel(f"quality/similarity_{device.family}.cl", "similarity", **macros)

    def __call__(self, pairs: Sequence[tuple[Picture, Picture]]) -> list[tuple[float, float]]:
        """PSNR in decibels (infinite for identical pictures) and SSIM of each pair of pictures of one size.

        Raises:
            DeviceError: the device failed, or has no room for the sums.
        """
        device = self._device
        starts = np.cumsum([0, *(math.prod(self._parts(image)) for image, _ in pairs)])
        with Memory(device) as memory:
            sums = memory.allocate(8 * int(starts[-1]), "the pictures' similarities")
            for (image, reference), start in zip(pairs, starts, strict=False):
                self._enqueue(image, reference, sums, int(start))
            parts = device.download(sums, (int(starts[-1]), 2), np.float32).astype(np.float64)
        return [
            _figures(parts[start:stop].sum(axis=0) / (3 * image.width * image.height))
            for (image, _), start, stop in zip(pairs, starts, starts[1:], strict=False)
        ]

    def _parts(self, picture: Picture) -> tuple[int, int]:
        """Parts that are summed on their own, along a row and along a column."""
        if self._on_gpu:
            return -(-picture.width // _TILE), -(-picture.height // _TILE)
        return -(-3 * picture.width // _VALUES), -(-picture.height // _ROWS)

    def _enqueue(self, image: Picture, reference: Picture, sums: cl.Buffer, first_sum: int) -> None:
        """Sums (parts of all pictures, 2) float32, squared errors and 1 - SSIM, from ``first_sum`` on."""
        self._kernel.bind(
            images=image.buffer,
            first_image=image.first,
            references=reference.buffer,
            first_reference=reference.first,
            width=image.width,
            height=image.height,
            sums=sums,
            first_sum=first_sum,
        )
        (columns, rows), side = self._parts(image), _TILE if self._on_gpu else 1
        self._kernel.launch((columns * side, rows * side), (side, side))


def _figures(means: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[float, float]:
    error, dissimilarity = (float(mean) for mean in means)
    return math.inf if error == 0 else -10 * math.log10(error), 1 - dissimilarity


def in_batches(device: Device, cameras: Sequence[Camera], most_bytes: int = _MOST_BYTES) -> Iterator[Sequence[Camera]]:
    """Views to render and compare together: on a GPU as many as take little memory, on a CPU one.

    Args:
        most_bytes: that the pictures of several views may take.
    """
    most = 32 if device.family == "gpu" else 1
    room = min(most_bytes, device.info.largest_buffer, (device.info.memory - device.allocated) // 8)
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
