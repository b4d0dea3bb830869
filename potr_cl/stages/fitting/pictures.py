"""The target pictures of a fit on the device, batch by batch: :class:`TargetPictures`."""

from __future__ import annotations

from collections.abc import Sequence

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch
from potr_cl.stages.refitting.kept_pictures import KeptPictures, Room
from potr_cl.stages.refitting.targets import Targets


class TargetPictures(Owner):
    """Pictures that are asked for in any order, again and again. As many as a budget allows are kept.

    Args:
        device: that they lie on.
        cameras: the views.
        targets: what these should show.
        room: bytes of device memory that the pictures which are kept may take.

    Raises:
        DeviceError: the device failed, or a picture does not fit it.
    """

    def __init__(self, device: Device, cameras: Sequence[Camera], targets: Targets, room: float) -> None:
        self._device, self._targets = device, targets
        self._pictures = KeptPictures(device, cameras, Room(room))
        self._batch = Scratch(device, "the target images")

    def prepare(self, numbers: Sequence[int]) -> None:
        """Have pictures ready, several at a time, as far as they are kept: all will be asked for sooner or later."""
        self._pictures.fill(self._targets, [(number,) for number in numbers], together=True)

    def of(self, numbers: Sequence[int]) -> cl.Buffer:
        """(pixels, 3) float32, the pictures of some views, one behind the other; the next call overwrites them."""
        if len(numbers) == 1:
            return self._pictures.of(self._targets, numbers)
        self._batch.reserve(self._pictures.nbytes(numbers))
        start = 0
        for number in numbers:
            picture, size = self._pictures.of(self._targets, [number]), self._pictures.nbytes([number])
            cl.enqueue_copy(self._device.queue, self._batch.buffer, picture, byte_count=size, dst_offset=start)
            start += size
        return self._batch.buffer

    def close(self) -> None:
        """Give all device memory back."""
        self._pictures.close()
        self._batch.close()
