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


#: Pixels along a side of a tile: GROUP in cl/quality/similarity_gpu.cl.
_TILE = 16


class GpuSimilarityLauncher:
    """See :class:`potr_cl.quality.metrics_device.SimilarityLauncher`."""

    most_views = 32

    def __init__(self, device: Device, macros: dict[str, float | int]) -> None:
        self._kernel = device.shared_kernel("quality/similarity_gpu.cl", "similarity", **macros)

    def parts(self, picture: Picture) -> tuple[int, int]:
        return -(-picture.width // _TILE), -(-picture.height // _TILE)

    def enqueue(self, image: Picture, reference: Picture, sums: cl.Buffer, first_sum: int) -> None:
        columns, rows = self.parts(image)
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
        self._kernel.launch((columns * _TILE, rows * _TILE), (_TILE, _TILE))


#: Values (of three a pixel) and rows that a work-item does.
_VALUES, _ROWS = 96, 32
#: Fewest values that the kernel takes at a time.
_LEAST_LANES = 8


class CpuSimilarityLauncher:
    """See :class:`potr_cl.quality.metrics_device.SimilarityLauncher`."""

    most_views = 1

    def __init__(self, device: Device, macros: dict[str, float | int]) -> None:
        lanes = max(device.vector_width, _LEAST_LANES)
        sizes = {"LANES": lanes, "BLOCK": _VALUES, "ROWS": _ROWS}
        self._kernel = device.shared_kernel("quality/similarity_cpu.cl", "similarity", **sizes, **macros)

    def parts(self, picture: Picture) -> tuple[int, int]:
        return -(-3 * picture.width // _VALUES), -(-picture.height // _ROWS)

    def enqueue(self, image: Picture, reference: Picture, sums: cl.Buffer, first_sum: int) -> None:
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
        self._kernel.launch(self.parts(image), (1, 1))


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
        window: dict[str, float | int] = {f"WEIGHT_{k}": float(weight) for k, weight in enumerate(WINDOW)}
        self._launcher: SimilarityLauncher = _launcher_class(device)(device, window | {"C1": C1, "C2": C2})

    def __call__(self, pairs: Sequence[tuple[Picture, Picture]]) -> list[tuple[float, float]]:
        """PSNR in decibels (infinite for identical pictures) and SSIM of each pair of pictures of one size.

        Raises:
            DeviceError: the device failed, or has no room for the sums.
        """
        device, launcher = self._device, self._launcher
        starts = np.cumsum([0, *(math.prod(launcher.parts(image)) for image, _ in pairs)])
        with Memory(device) as memory:
            sums = memory.allocate(8 * int(starts[-1]), "the pictures' similarities")
            for (image, reference), start in zip(pairs, starts, strict=False):
                launcher.enqueue(image, reference, sums, int(start))
            parts = device.download(sums, (int(starts[-1]), 2), np.float32).astype(np.float64)
        return [
            _figures(parts[start:stop].sum(axis=0) / (3 * image.width * image.height))
            for (image, _), start, stop in zip(pairs, starts, starts[1:], strict=False)
        ]


class SimilarityLauncher(Protocol):
    """Enqueues the sums of one kernel family.

    Attributes:
        most_views: views to render together.
    """

    most_views: int

    def parts(self, picture: Picture) -> tuple[int, int]:
        """Parts of a picture that are summed on their own, along a row and along a column."""

    def enqueue(self, image: Picture, reference: Picture, sums: cl.Buffer, first_sum: int) -> None:
        """Enqueue the comparison of two pictures of one size.

        Args:
            sums: (parts of all pictures, 2) float32, squared errors and 1 - SSIM.
            first_sum: where those of these pictures begin.
        """


def _launcher_class(device: Device) -> type[CpuSimilarityLauncher] | type[GpuSimilarityLauncher]:
    return GpuSimilarityLauncher if device.family == "gpu" else CpuSimilarityLauncher


def _figures(means: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[float, float]:
    error, dissimilarity = (float(mean) for mean in means)
    return math.inf if error == 0 else -10 * math.log10(error), 1 - dissimilarity


def in_batches(device: Device, cameras: Sequence[Camera], most_bytes: int = _MOST_BYTES) -> Iterator[Sequence[Camera]]:
    """Views to render and compare together: on a GPU as many as take little memory, on a CPU one.

    Args:
        most_bytes: that the pictures of several views may take.
    """
    most = _launcher_class(device).most_views
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
