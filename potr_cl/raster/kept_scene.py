"""A scene that stays on devices while one after another renders it: :class:`KeptScene`."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from contextlib import suppress

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.host.threads import in_background
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers, uploaded

#: A scene that takes more than this part of the device's memory is not kept: others may need the room.
_PART = 10


class KeptScene(Owner):
    """Uploads a scene once for several rasterizers, where the device has much more memory than it takes.

    Args:
        device: to keep it on.
        scene: whose arrays do not change meanwhile.
    """

    def __init__(self, device: Device, scene: Scene) -> None:
        self._device, self._scene = device, scene
        self._buffers = self._uploaded(device)
        self._elsewhere: dict[Device, Future[SceneBuffers | None]] = {}
        self._lock = threading.Lock()

    def _uploaded(self, device: Device) -> SceneBuffers | None:
        if _PART * self._scene.nbytes <= device.info.memory:
            with suppress(DeviceMemoryError):
                return uploaded(device, self._scene)
        return None

    def is_of(self, scene: Scene) -> bool:
        """Whether it is this scene."""
        return scene is self._scene

    def drawable(self, device: Device, scene: Scene) -> Drawable:
        """What to give to a rasterizer for a scene: what is kept, if it is this scene and on this device."""
        if self._buffers is not None and self.is_of(scene) and device is self._device:
            return self._buffers
        return scene

    def bring_to(self, device: Device) -> Future[SceneBuffers | None]:
        """Begin to upload it to another device as well, to be kept there too, and do not wait for it."""
        with self._lock:
            if device not in self._elsewhere:
                # In a thread of its own: what this thread takes may belong to something that fails.
                self._elsewhere[device] = in_background(self._uploaded, device)
            return self._elsewhere[device]

    def on(self, device: Device) -> Drawable:
        """What to give to a rasterizer for the scene, on this device or another one.

        Raises:
            DeviceError: the other device failed.
        """
        buffers = self._buffers if device is self._device else self.bring_to(device).result()
        return self._scene if buffers is None else buffers

    def close(self) -> None:
        kept = [self._buffers]
        for future in self._elsewhere.values():
            with suppress(DeviceError):
                kept.append(future.result())
        for buffers in kept:
            if buffers is not None:
                buffers.close()
        self._buffers, self._elsewhere = None, {}


def drawable_on(device: Device, scene: Scene | KeptScene) -> Drawable:
    """What to give to a rasterizer on a device for a scene, which may be one that is kept on devices.

    Raises:
        DeviceError: the device failed.
    """
    return scene.on(device) if isinstance(scene, KeptScene) else scene
