"""The pictures of a large scene, each rendered with what its view may draw: :class:`VisibleTargets`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner, Reused
from potr_cl.raster.culling import Sights
from potr_cl.raster.picked_splats import PickedSplats, Picker, Picks
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers


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
            # Drawn where a view sees nothing: it is not in the picture either.
            self._any = memory.upload(np.zeros(1, np.uint32), "the number of a splat")
            self._owned = owned.pop_all()

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :meth:`potr_cl.stages.refitting.targets.Targets.into`."""
        start = 0
        for number in numbers:
            camera = self._cameras[number]
            try:
                splats = self._picks.counts[number]
                picked = self._picks.numbers(self._passing, number) if splats else self._any
                scene = PickedSplats(self._whole, picked, max(splats, 1))
                with Rasterizer(
                    self._whole.device, scene, background=self._background, preparing=self._preparing
                ) as rasterizer:
                    rasterizer.render_into([camera], buffer, start, self._passing)
            finally:
                self._passing.close()
            start += 12 * camera.width * camera.height

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
