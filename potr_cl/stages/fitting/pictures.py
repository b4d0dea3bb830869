"""The target pictures of a fit on the device, batch by batch: :class:`TargetPictures`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
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
        self._device, self._cameras, self._targets, self._room = device, list(cameras), targets, room
        self._memory = Memory(device)
        self._kept: dict[int, cl.Buffer] = {}
        self._one = Scratch(device, "a target image")
        self._batch = Scratch(device, "the target images")

    def of(self, numbers: Sequence[int]) -> cl.Buffer:
        """(pixels, 3) float32, the pictures of some views, one behind the other; the next call overwrites them."""
        sizes = [self._nbytes(number) for number in numbers]
        self._batch.reserve(sum(sizes))
        start = 0
        for number, nbytes in zip(numbers, sizes, strict=True):
            picture = self._picture(number)
            cl.enqueue_copy(self._device.queue, self._batch.buffer, picture, byte_count=nbytes, dst_offset=start)
            start += nbytes
        return self._batch.buffer

    def download(self, number: int) -> FloatArray:
        """(H, W, 3) float32, the picture of one view."""
        camera = self._cameras[number]
        picture: FloatArray = self._device.download(self.of([number]), (camera.height, camera.width, 3), np.float32)
        return picture

    def _nbytes(self, number: int) -> int:
        camera = self._cameras[number]
        return 12 * camera.width * camera.height

    def _picture(self, number: int) -> cl.Buffer:
        if number in self._kept:
            return self._kept[number]
        nbytes = self._nbytes(number)
        if nbytes > self._room:
            self._one.reserve(nbytes)
            self._targets.into([number], self._one.buffer)
            return self._one.buffer
        buffer = self._memory.allocate(nbytes, "a target image")
        self._room -= buffer.size
        self._targets.into([number], buffer)
        self._kept[number] = buffer
        return buffer

    def close(self) -> None:
        """Give all device memory back."""
        for owner in (self._memory, self._one, self._batch):
            owner.close()
        self._kept = {}
