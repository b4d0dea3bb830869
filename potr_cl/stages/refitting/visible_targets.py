"""The pictures of a large scene, each rendered with what its view may draw: :class:`VisibleTargets`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.views.pictures import SeenRasterizer
from potr_cl.views.visibility import Visibility


class VisibleTargets(Owner):
    """What :class:`potr_cl.stages.refitting.targets.RenderedTargets` is, for a scene of which no view sees much.

    The pictures are the same bits, see :class:`potr_cl.views.pictures.SeenRasterizer`.

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
        """See :meth:`potr_cl.stages.refitting.targets.Targets.into`."""
        self._pictures.draw(self._picks, numbers, [self._cameras[number] for number in numbers], buffer)

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
