"""The pictures that a re-fit or a fit should come near to, and where they come from: :class:`Targets`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
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
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.views.budget import target_bytes
from potr_cl.views.pictures import SeenRasterizer
from potr_cl.views.visibility import Visibility


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


class VisibleTargets(Owner):
    """The same of a large scene, each picture rendered with what its view may draw: they are the same bits.

    Args:
        whole: the scene, on a GPU; it stays the caller's.
        cameras: the views.
        sights: what each of them may draw.
        background: R, G, B behind the scene.

    Raises:
        DeviceError: the device has no room for the numbers of the splats' groups.
    """

    def __init__(
        self, whole: SceneBuffers, cameras: Sequence[Camera], sights: Visibility, background: tuple[float, float, float]
    ) -> None:
        self._cameras = list(cameras)
        with ExitStack() as owned:
            self._pictures = owned.enter_context(
                SeenRasterizer(whole.device, whole, sights.groups, background=background)
            )
            self._picks = self._pictures.picks(owned.enter_context(Memory(whole.device)), sights.seen)
            self._owned = owned.pop_all()

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`Targets.into`."""
        self._pictures.draw(self._picks, numbers, [self._cameras[number] for number in numbers], buffer)

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()


@contextmanager
def targets_of(
    device: Device,
    scene: Drawable,
    cameras: Sequence[Camera],
    background: tuple[float, float, float],
    sights: Visibility | None = None,
) -> Iterator[Targets]:
    """A scene's pictures, with what each view may draw where that is known and the scene lies on a GPU.

    Raises:
        DeviceError: the scene does not fit the device.
    """
    if sights is not None and isinstance(scene, SceneBuffers) and device.family == "gpu":
        with VisibleTargets(scene, cameras, sights, background) as visible:
            yield visible
        return
    with Rasterizer(device, scene, background=background) as rasterizer:
        yield RenderedTargets(rasterizer, cameras)


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
        self._ends = np.cumsum([0, *(target_bytes(camera) // 4 for camera in cameras)])
        self._pictures = mapped.array((int(self._ends[-1]),), np.float32, "pictures")
        largest = max(map(target_bytes, cameras))
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
