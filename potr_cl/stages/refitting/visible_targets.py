"""The pictures of a large scene, each rendered with what its view may draw: :class:`VisibleTargets`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner, Reused
from potr_cl.raster.culling import Sights
from potr_cl.raster.picked_splats import NO_SPLAT, PickedSplats, Picker, Picks
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

#: Views that are rendered together at most, and splats of all of them, padding included.
_TOGETHER, _PROJECTED = 8, 1 << 24


class VisibleTargets(Owner):
    """What :class:`potr_cl.stages.refitting.targets.RenderedTargets` is, for a scene of which no view sees much.

    The pictures are the same bits: what is left out is drawn nowhere. All views take turns in the same memory.

    Args:
        whole: the scene, on a GPU; it stays the caller's.
        cameras: the views.
        sights: what each of them may draw.
        background: R, G, B behind the scene.

    Raises:
        DeviceError: the device has no room for the numbers of the splats' groups.
    """

    def __init__(
        self, whole: SceneBuffers, cameras: Sequence[Camera], sights: Sights, background: tuple[float, float, float]
    ) -> None:
        device = whole.device
        self._whole, self._cameras, self._background = whole, list(cameras), background
        with ExitStack() as owned:
            self._preparing = owned.enter_context(PreparingMemory(device))
            self._passing = Reused(device)
            owned.callback(self._passing.give_back)
            memory = owned.enter_context(Memory(device))
            picker = owned.enter_context(Picker(device, sights.groups.group_of))
            self._picks = Picks(memory, picker, sights.seen)
            self._owned = owned.pop_all()

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`potr_cl.stages.refitting.targets.Targets.into`."""
        start = 0
        for together in self._batches(numbers):
            self._render(together, buffer, start)
            start += sum(self._nbytes(number) for number in together)

    def _batches(self, numbers: Sequence[int]) -> Iterator[Sequence[int]]:
        """Neighbours that are rendered together: the longest tile list of one keeps few work-groups busy."""
        first, stride = 0, 0
        for place, number in enumerate(numbers):
            more = max(stride, self._picks.counts[number], 1)
            if place > first and (place - first == _TOGETHER or (place + 1 - first) * more > _PROJECTED):
                yield numbers[first:place]
                first, more = place, max(self._picks.counts[number], 1)
            stride = more
        if len(numbers) > first:
            yield numbers[first:]

    def _render(self, numbers: Sequence[int], buffer: cl.Buffer, start: int) -> None:
        device = self._whole.device
        stride = -(-max(*(self._picks.counts[number] for number in numbers), 1) // SPLAT_GROUP) * SPLAT_GROUP
        try:
            picked = self._passing.allocate(4 * stride * len(numbers), "the numbers of views' splats")
            device.fill(picked, np.uint32(NO_SPLAT), 4 * stride * len(numbers))
            for place, number in enumerate(numbers):
                if self._picks.counts[number]:
                    self._picks.numbers_into(picked, place * stride, number)
            scene = PickedSplats(self._whole, picked, stride, apart=stride)
            with Rasterizer(device, scene, background=self._background, preparing=self._preparing) as rasterizer:
                views = rasterizer.prepare_set([self._cameras[number] for number in numbers], self._passing)
                rasterizer.pictures_into(views, buffer, start)
        except DeviceMemoryError:
            if len(numbers) == 1:
                raise
            few = True
        else:
            few = False
        finally:
            self._passing.close()
        if few:
            middle = len(numbers) // 2
            self._render(numbers[:middle], buffer, start)
            more = sum(self._nbytes(number) for number in numbers[:middle])
            self._render(numbers[middle:], buffer, start + more)

    def _nbytes(self, number: int) -> int:
        return 12 * self._cameras[number].width * self._cameras[number].height

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
