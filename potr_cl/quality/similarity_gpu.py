"""The sums of PSNR and SSIM on GPUs: a tile of a picture a work-group, a pixel a work-item."""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.quality.pictures import Picture

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
