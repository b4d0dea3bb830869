"""The views that a fit does not look at, and that say whether it helps: :class:`Judges`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.views.targets import TargetPictures

#: Work-items that sum up a picture's squared differences, and those of a group.
_ITEMS, _GROUP = 1 << 14, 64


class Judges(Owner):
    """Views that are held out of a fit.

    Args:
        device: to compute on.
        rasterizer: of the scene, which may change between two calls.
        cameras: all views.
        pictures: what they should show.
        held_out: the numbers of those that judge.

    Raises:
        DeviceError: the sums do not fit the device, or the kernel cannot be built.
    """

    def __init__(
        self,
        device: Device,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        pictures: TargetPictures,
        held_out: Sequence[int],
    ) -> None:
        self._device, self._rasterizer, self._cameras, self._pictures = device, rasterizer, cameras, pictures
        self._held_out = list(held_out)
        self._kernel = device.shared_kernel("fit/squared_error.cl", "squared_error")
        self._memory = Memory(device)
        self._sums = self._memory.allocate(4 * _ITEMS * max(len(self), 1), "the judges' sums")

    def __len__(self) -> int:
        return len(self._held_out)

    def error(self) -> float:
        """The mean squared error of the scene as it is now, all views the same.

        Raises:
            DeviceError: a view does not fit the device, or the device failed.
        """
        for place, number in enumerate(self._held_out):
            image, _ = self._rasterizer.render_device(self._cameras[number])
            self._kernel.bind(
                picture=image,
                target=self._pictures.of([number]),
                count=self._values(number),
                sums=self._sums,
                first_sum=_ITEMS * place,
            )
            self._kernel.launch((_ITEMS,), (_GROUP,))
        sums = self._device.download(self._sums, (len(self), _ITEMS), np.float32).sum(axis=1, dtype=np.float64)
        return float(np.mean(sums / [self._values(number) for number in self._held_out]))

    def _values(self, number: int) -> int:
        camera = self._cameras[number]
        return 3 * camera.width * camera.height

    def close(self) -> None:
        """Give all device memory back."""
        self._memory.close()
