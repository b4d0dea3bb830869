"""The pictures that the re-fit should come near to: :class:`Targets`, where they come from, and which are kept."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

import numpy as np
import pyopencl as cl

from potr_cl.host import mapped
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer


class Targets(Protocol):
    """What the pictures of some numbered views should show."""

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """Write the pictures of several views to device memory.

        Args:
            numbers: of the views.
            buffer: takes (H, W, 3) float32 of each, one behind the other from its beginning on.

        Raises:
            DeviceError: the device failed, or a view does not fit it.
        """
        ...


class RenderedTargets:
    """The pictures that another scene gives: the uncompressed one's.

    Args:
        rasterizer: of that scene.
        cameras: the views.
    """

    def __init__(self, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> None:
        self._rasterizer = rasterizer
        self._cameras = list(cameras)

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`Targets.into`."""
        self._rasterizer.render_into([self._cameras[number] for number in numbers], buffer)


#: Bytes of pictures that are rendered together to be remembered.
_TOGETHER = 1 << 26


class RememberedTargets(Owner):
    """The pictures of others, asked for once and kept on the host: what made them can go.

    Where memory is bounded, many of them lie in a temporary file (:mod:`potr_cl.host.mapped`).

    Args:
        device: that computes.
        targets: give the pictures.
        cameras: the views.

    Raises:
        PotrError: there is no room for them.
        DeviceError: the device failed, or a view does not fit it.
    """

    def __init__(self, device: Device, targets: Targets, cameras: Sequence[Camera]) -> None:
        self._ferry = Ferry(device)
        self._ends = np.cumsum([0, *(nbytes(camera) // 4 for camera in cameras)])
        self._pictures = mapped.array((int(self._ends[-1]),), np.float32, "pictures")
        largest = max(map(nbytes, cameras))
        # On a GPU several at a time are rendered faster.
        together = 1 if device.family == "cpu" else min(max(_TOGETHER // largest, 1), len(cameras))
        with Memory(device) as memory, ThreadPoolExecutor(1) as thread:
            # One thread takes pictures to the host while the next ones are rendered.
            buffers = [memory.allocate(together * largest, "the target images") for _ in range(2)]
            taken: Future[None] | None = None
            for first in range(0, len(cameras), together):
                numbers = range(first, min(first + together, len(cameras)))
                targets.into(numbers, buffers[0])
                own = self._pictures[self._ends[numbers.start] : self._ends[numbers.stop]]
                if taken is not None:
                    taken.result()
                taken = thread.submit(self._ferry.to_host, [Cargo(own)], buffers[0])
                buffers.reverse()
            if taken is not None:
                taken.result()

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`Targets.into`."""
        cargo, start = [], 0
        for number in numbers:
            cargo.append(Cargo(self._picture(number), start))
            start += cargo[-1].values.nbytes
        self._ferry.to_device(buffer, cargo)

    def close(self) -> None:
        """Keep nothing any more."""
        self._ferry.close()
        self._pictures = self._pictures[:0]

    def _picture(self, number: int) -> FloatArray:
        return self._pictures[self._ends[number] : self._ends[number + 1]]


def nbytes(camera: Camera) -> int:
    """Bytes of a view's picture."""
    return 12 * camera.width * camera.height


class Photographs(Protocol):
    """Gives pictures by camera; :class:`potr_cl.quality.ground_truth.GroundTruth` does."""

    def picture(self, camera: Camera) -> FloatArray:
        """(H, W, 3) float32, the photograph of a view."""
        ...


class GroundTruthTargets:
    """Photographs, read anew whenever they are asked for.

    Args:
        device: that the re-fit computes on.
        ground_truth: has photographs of all the cameras.
        cameras: the views.
    """

    def __init__(self, device: Device, ground_truth: Photographs, cameras: Sequence[Camera]) -> None:
        self._device = device
        self._ground_truth = ground_truth
        self._cameras = list(cameras)

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`Targets.into`.

        Raises:
            UsageError: a photograph cannot be opened.
            DataError: one is damaged.
        """
        start = 0
        for number in numbers:
            picture = np.ascontiguousarray(self._ground_truth.picture(self._cameras[number]), np.float32)
            with self._device.errors("failed to take a photograph"):
                cl.enqueue_copy(self._device.queue, buffer, picture, dst_offset=start, is_blocking=True)
            start += picture.nbytes


class Budget(Protocol):
    """Bytes of device memory that several share."""

    #: What is left.
    room: float


class TargetCache(Owner):
    """Target pictures on the device. Those that fit the memory budget are kept after their first use.

    Args:
        device: whose memory it is.
        cameras: the views.
        launches: the numbers of the views that are asked for together.
        budget: that the pictures which are kept are taken from.
        numbers: of these cameras among the views that targets know.

    Raises:
        DeviceMemoryError: the device has no room for those of one launch.
    """

    def __init__(
        self,
        device: Device,
        cameras: Sequence[Camera],
        launches: Sequence[range],
        budget: Budget,
        numbers: Sequence[int],
    ) -> None:
        self._numbers = numbers
        self._nbytes = {launch: sum(nbytes(cameras[number]) for number in launch) for launch in launches}
        self._budget = budget
        self._memory = Memory(device)
        self._others = self._memory.allocate(max(self._nbytes.values(), default=0), "the target images")
        self._kept: dict[range, cl.Buffer] = {}
        self._kept_of: Targets | None = None

    def fill(self, targets: Targets) -> None:
        """Have those pictures of these targets that are kept."""
        self._keep_only(targets)
        for launch, size in self._nbytes.items():
            if launch not in self._kept and size <= self._budget.room:
                self.pictures(targets, launch)

    def pictures(self, targets: Targets, numbers: range) -> cl.Buffer:
        """(pixels, 3) float32, what the views of a launch should show, one behind the other.

        They are valid until the next call. Other targets than at the last call take the place of what was kept.
        """
        self._keep_only(targets)
        if numbers in self._kept:
            return self._kept[numbers]
        size = self._nbytes[numbers]
        if size > self._budget.room:
            targets.into(self._among_all(numbers), self._others)
            return self._others
        buffer = self._memory.allocate(size, "the target images")
        self._budget.room -= buffer.size
        self._kept[numbers] = buffer
        try:
            targets.into(self._among_all(numbers), buffer)
        except BaseException:
            self._drop(numbers)
            raise
        return buffer

    def _keep_only(self, targets: Targets) -> None:
        if targets is not self._kept_of:
            self._forget()
            self._kept_of = targets

    def _among_all(self, numbers: range) -> list[int]:
        return [self._numbers[number] for number in numbers]

    def _drop(self, numbers: range) -> None:
        buffer = self._kept.pop(numbers)
        self._budget.room += buffer.size
        self._memory.free(buffer)

    def _forget(self) -> None:
        for numbers in list(self._kept):
            self._drop(numbers)

    def close(self) -> None:
        """Give all device memory back."""
        self._forget()
        self._memory.close()
