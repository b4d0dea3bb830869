"""Pictures that a re-fit will ask for, rendered while the host still rounds its geometry: :class:`PicturesAhead`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.host.threads import in_background
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.stages.refitting.targets import Targets, targets_of
from potr_cl.views.budget import target_bytes
from potr_cl.views.visibility import Visibility

#: They take no more than this part of a device's memory: for a moment they lie there twice.
_PART = 1 / 16


class PicturesAhead(Owner):
    """Renders a kept scene's pictures in a thread a device, where that has much more room than they take.

    A CPU renders none: it has the geometry to round.

    Args:
        source: the scene.
        background: R, G, B behind it.
        cameras: all views.
        numbers: of the views whose pictures each device will be asked for.
        sights: what each view may draw, where no view sees much of the scene.

    Attributes:
        source: as given.
    """

    def __init__(
        self,
        source: KeptScene,
        background: tuple[float, float, float],
        cameras: Sequence[Camera],
        numbers: Mapping[Device, Sequence[int]],
        sights: Visibility | None = None,
    ) -> None:
        self.source = source
        self._begun: dict[Device, Future[_Pictures | None]] = {
            device: in_background(_rendered, device, source, background, cameras, some, sights)
            for device, some in numbers.items()
            if device.family == "gpu" and some
        }

    def before(self, device: Device, targets: Targets) -> Targets:
        """The pictures that ``targets`` gives, on a device: it is asked for those that were not rendered ahead.

        Those that were are given once. When all have been given, their memory is given back.
        """
        begun = self._begun.get(device)
        return targets if begun is None else _AheadOf(begun, targets)

    def close(self) -> None:
        """Give all device memory back."""
        for begun in self._begun.values():
            with suppress(DeviceError):
                pictures = begun.result()
                if pictures is not None:
                    pictures.close()


class _AheadOf:
    """A :class:`potr_cl.stages.refitting.targets.Targets`."""

    def __init__(self, begun: Future[_Pictures | None], targets: Targets) -> None:
        self._begun, self._targets = begun, targets

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`Targets.into`."""
        pictures = self._begun.result()
        if pictures is None or not pictures.give(numbers, buffer):
            self._targets.into(numbers, buffer)


class _Pictures(Owner):
    """Pictures on a device, one behind the other.

    Args:
        device: that has them.
        cameras: all views.
        numbers: of those whose pictures they are.

    Attributes:
        buffer: to be filled with them.

    Raises:
        DeviceMemoryError: the device has no room.
    """

    def __init__(self, device: Device, cameras: Sequence[Camera], numbers: Sequence[int]) -> None:
        self._device = device
        ends = np.cumsum([0, *(target_bytes(cameras[number]) for number in numbers)])
        self._places = {
            number: (int(start), int(end)) for number, start, end in zip(numbers, ends[:-1], ends[1:], strict=True)
        }
        self._memory = Memory(device)
        self.buffer = self._memory.allocate(int(ends[-1]), "the target images")

    def give(self, numbers: Sequence[int], buffer: cl.Buffer) -> bool:
        """Enqueue copies to another buffer; whether all are there."""
        if any(number not in self._places for number in numbers):
            return False
        to = 0
        for number in numbers:
            start, end = self._places.pop(number)
            with self._device.errors("failed while computing"):
                cl.enqueue_copy(
                    self._device.queue, buffer, self.buffer, byte_count=end - start, src_offset=start, dst_offset=to
                )
            to += end - start
        if not self._places:
            self.close()
        return True

    def close(self) -> None:
        """Give the device's memory back."""
        self._places = {}
        self._memory.close()


def _rendered(
    device: Device,
    source: KeptScene,
    background: tuple[float, float, float],
    cameras: Sequence[Camera],
    numbers: Sequence[int],
    sights: Visibility | None,
) -> _Pictures | None:
    """Some views' pictures on a device; None: it has not much room, or the scene does not lie there."""
    if sum(target_bytes(cameras[number]) for number in numbers) > _PART * device.info.memory:
        return None
    scene = source.on(device)
    if not isinstance(scene, SceneBuffers):
        return None
    with suppress(DeviceMemoryError), device.all_or_nothing():
        pictures = _Pictures(device, cameras, numbers)
        with targets_of(device, scene, cameras, background, sights) as targets:
            targets.into(numbers, pictures.buffer)
        return pictures
    return None
