"""A scene that stays on a device while one after another renders it: :class:`KeptScene`."""

from __future__ import annotations

from contextlib import suppress

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers, uploaded

#: A scene that takes more than this part of the device's memory is not kept: others may need the room.
_PART = 16


class KeptScene(Owner):
    """Uploads a scene once for several rasterizers, where the device has much more memory than it takes.

    Args:
        device: to keep it on.
        scene: whose arrays do not change meanwhile.
    """

    def __init__(self, device: Device, scene: Scene) -> None:
        self._device, self._scene = device, scene
        self._buffers: SceneBuffers | None = None
        if _PART * scene.nbytes <= device.info.memory:
            with suppress(DeviceMemoryError):
                self._buffers = uploaded(device, scene)

    def drawable(self, device: Device, scene: Scene) -> Drawable:
        """What to give to a rasterizer for a scene: what is kept, if it is this scene and on this device."""
        if self._buffers is not None and scene is self._scene and device is self._device:
            return self._buffers
        return scene

    def close(self) -> None:
        if self._buffers is not None:
            self._buffers.close()
        self._buffers = None
