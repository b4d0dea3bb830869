"""The sums of PSNR and SSIM on CPUs: some rows of some values of a picture a work-item."""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.quality.pictures import Picture

#: Values (of three a pixel) and rows that a work-item does: BLOCK and ROWS in cl/quality/similarity_cpu.cl.
_VALUES, _ROWS = 96, 32
#: Fewest values that the kernel takes at a time.
_LEAST_LANES = 8


class CpuSimilarityLauncher:
    """See :class:`potr_cl.quality.metrics_device.SimilarityLauncher`."""

    most_views = 1

    def __init__(self, device: Device, macros: dict[str, float | int]) -> None:
        lanes = max(device.vector_width, _LEAST_LANES)
        self._kernel = device.shared_kernel("quality/similarity_cpu.cl", "similarity", LANES=lanes, **macros)

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
