"""The target pictures of a fit on the device, batch by batch: :class:`TargetPictures`."""

from __future__ import annotations

from collections.abc import Sequence

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.stages.refitting.targets import Targets

#: Pictures that are asked for together, and their bytes at the most: a GPU prepares several views in one go.
_TOGETHER, _MOST_BYTES = 16, 1 << 28


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
        self._some = Scratch(device, "some target images")
        self._batch = Scratch(device, "the target images")

    def prepare(self, numbers: Sequence[int]) -> None:
        """Have pictures ready, several at a time, as far as they are kept: all will be asked for sooner or later."""
        waiting: list[int] = []
        room = self._room
        for number in numbers:
            if number in self._kept:
                continue
            room -= self._nbytes(number)
            if room < 0:
                break
            if waiting and (len(waiting) == _TOGETHER or self._bytes_of([*waiting, number]) > _MOST_BYTES):
                self._take(waiting)
                waiting = []
            waiting.append(number)
        self._take(waiting)
        self._some.close()

    def of(self, numbers: Sequence[int]) -> cl.Buffer:
        """(pixels, 3) float32, the pictures of some views, one behind the other; the next call overwrites them."""
        self._batch.reserve(self._bytes_of(numbers))
        start = 0
        for number in numbers:
            picture, nbytes = self._picture(number), self._nbytes(number)
            cl.enqueue_copy(self._device.queue, self._batch.buffer, picture, byte_count=nbytes, dst_offset=start)
            start += nbytes
        return self._batch.buffer

    def _bytes_of(self, numbers: Sequence[int]) -> int:
        return sum(self._nbytes(number) for number in numbers)

    def _nbytes(self, number: int) -> int:
        camera = self._cameras[number]
        return 12 * camera.width * camera.height

    def _picture(self, number: int) -> cl.Buffer:
        if number in self._kept:
            return self._kept[number]
        nbytes = self._nbytes(number)
        if nbytes > self._room:
            self._some.reserve(nbytes)
            self._targets.into([number], self._some.buffer)
            return self._some.buffer
        buffer = self._keep(number)
        self._targets.into([number], buffer)
        return buffer

    def _take(self, numbers: Sequence[int]) -> None:
        """Keep pictures, for which there is room."""
        if not numbers:
            return
        self._some.reserve(self._bytes_of(numbers))
        self._targets.into(numbers, self._some.buffer)
        start = 0
        for number in numbers:
            nbytes, buffer = self._nbytes(number), self._keep(number)
            cl.enqueue_copy(self._device.queue, buffer, self._some.buffer, byte_count=nbytes, src_offset=start)
            start += nbytes

    def _keep(self, number: int) -> cl.Buffer:
        """Memory for a picture that is kept."""
        buffer = self._memory.allocate(self._nbytes(number), "a target image")
        self._room -= buffer.size
        self._kept[number] = buffer
        return buffer

    def close(self) -> None:
        """Give all device memory back."""
        for owner in (self._memory, self._some, self._batch):
            owner.close()
        self._kept = {}
