"""Scenes that lie on devices, or are on their way there: :class:`SceneHandle` is one, :func:`scene_on` gets it.

:class:`ResidentScene` stays on devices while one after another renders it, and :class:`ResidentSubset` is some of its
splats; :class:`HostScene` and :class:`DeviceScene` go from where they are to other devices of this process, and
:class:`SceneSubset` to another process.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.host.threads import in_background
from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import Indices, SplatGroups
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers, copied, gathered, uploaded


class SceneHandle(ABC):
    """A scene that goes to several devices, each of which makes its own of it."""

    @property
    def nbytes(self) -> int:
        """Bytes that travel."""
        return 0

    @abstractmethod
    def on(self, device: Device) -> AbstractContextManager[Drawable]:
        """What to give to a rasterizer on a device, as long as the context lasts."""


def scene_on(device: Device, scene: Drawable | SceneHandle) -> AbstractContextManager[Drawable]:
    """What to give to a rasterizer on a device for a scene, as long as the context lasts."""
    return scene.on(device) if isinstance(scene, SceneHandle) else nullcontext(scene)


@dataclass(frozen=True)
class HostScene(SceneHandle):
    """A scene of this process's host.

    Attributes:
        scene: the scene.
        travels: whether it goes to other processes; threads of this one see what there is.
    """

    scene: Scene
    travels: bool = False

    @property
    def nbytes(self) -> int:
        return self.scene.nbytes if self.travels else 0

    @contextmanager
    def on(self, device: Device) -> Iterator[Drawable]:
        yield self.scene


class DeviceScene(SceneHandle):
    """A scene that lies on one device, for others of this process to copy; it stays as it is meanwhile.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: SceneBuffers) -> None:
        self._scene = scene
        self._lent = {name: Lent(scene.device, buffer, buffer.size) for name, buffer in scene.parameters.items()}

    @property
    def nbytes(self) -> int:
        return sum(lent.nbytes for lent in self._lent.values())

    @contextmanager
    def on(self, device: Device) -> Iterator[Drawable]:
        scene = self._scene
        if device is scene.device:
            yield scene
            return
        own = SceneBuffers(device, scene.splats, scene.sh_count, scene.antialiased, scene.low_pass)
        with own, Relay(device) as relay:
            for name, buffer in own.parameters.items():
                relay.fetch(buffer, self._lent[name])
            yield own


@dataclass(frozen=True)
class SceneSubset(SceneHandle):
    """Some splats of a scene. They are gathered on their way to another process, where they arrive as a scene.

    Attributes:
        scene: the scene.
        splats: (n,) int64, their numbers there, ascending.
    """

    scene: Scene
    splats: Indices

    @property
    def nbytes(self) -> int:
        """Bytes of these splats."""
        return self.scene.nbytes * len(self.splats) // max(len(self.scene), 1)

    @contextmanager
    def on(self, device: Device) -> Iterator[Drawable]:
        yield self.scene.subset(self.splats)

    def __reduce__(self) -> tuple[Callable[[Scene], Scene], tuple[Scene]]:
        return _as_it_is, (self.scene.subset(self.splats),)


def _as_it_is(scene: Scene) -> Scene:
    return scene


#: A scene that takes more than this part of the device's own memory, or of the host's, is not kept: others may need the
#: room. Fifty million splats stay on a GPU of 80 GB.
_PART, _PART_OF_HOST = 6, 10
#: Nor is it there for a while if it takes more than this one.
_AWHILE = 3
#: The whole scene is on the device too where that has so many times as much memory.
_WHOLE = 3


class ResidentScene(Owner, SceneHandle):
    """Uploads a scene once for several rasterizers, where the device has much more memory than it takes.

    It is on its way when this is made; who asks for it waits.

    Args:
        device: to keep it on.
        scene: whose arrays do not change meanwhile.
        memory: bytes that the user would have taken; None: as much as there is. Where a device's memory is the host's,
            a scene that is a large part of it is not kept: it is there already.
        others: devices of this process that it is brought to as well.

    Attributes:
        groups: of the scene's splats, once somebody has found that views see little of it.
    """

    def __init__(self, device: Device, scene: Scene, memory: int | None = None, others: Sequence[Device] = ()) -> None:
        self._device, self._scene, self._budget = device, scene, memory
        self._on: dict[Device, Future[SceneBuffers | None]] = {}
        self._lock = threading.Lock()
        self.groups: SplatGroups | None = None
        for each in (device, *others):
            self.bring_to(each)

    def _placed(self, device: Device) -> SceneBuffers | None:
        part = _PART_OF_HOST if device.info.shares_host_memory else _PART
        if part * self._scene.nbytes <= _allowed(device, self._budget):
            # To make a scene ready on the host takes many times as long as to copy it from device to device.
            first = None if device is self._device else self._on[self._device].result()
            with suppress(DeviceMemoryError):
                return uploaded(device, self._scene) if first is None else copied(device, first)
        return None

    def is_large_for(self, device: Device, scene: Scene | None = None) -> bool:
        """Whether the scene, or another one, had better not lie whole on a device even for a while."""
        return large_for(device, (self._scene if scene is None else scene).nbytes, self._budget)

    @property
    def scene(self) -> Scene:
        """The scene on the host."""
        return self._scene

    def is_of(self, scene: Scene) -> bool:
        """Whether it is this scene."""
        return scene is self._scene

    def drawable(self, device: Device, scene: Scene) -> Drawable:
        """What to give to a rasterizer for a scene: what is kept, if it is this scene, brought to this device."""
        return self.found_on(device) if self.is_of(scene) and device in self._on else scene

    def bring_to(self, device: Device) -> Future[SceneBuffers | None]:
        """Begin to bring it to a device, to be kept there, and do not wait for it."""
        with self._lock:
            if device not in self._on:
                # In a thread of its own: what this thread takes may belong to something that fails.
                self._on[device] = in_background(self._placed, device)
            return self._on[device]

    def found_on(self, device: Device) -> Drawable:
        """What to give to a rasterizer for the scene, on this device or another one."""
        buffers = self.bring_to(device).result()
        return self._scene if buffers is None else buffers

    @contextmanager
    def on(self, device: Device) -> Iterator[Drawable]:
        yield self.found_on(device)

    def close(self) -> None:
        for future in self._on.values():
            with suppress(DeviceError):
                buffers = future.result()
                if buffers is not None:
                    buffers.close()
        self._on = {}


def large_for(device: Device, nbytes: int, memory: int | None) -> bool:
    """Whether a scene had better not lie whole on a device even for a while.

    Args:
        device: to render on.
        nbytes: of the scene.
        memory: bytes that the user would have taken; None: as much as there is.
    """
    return _AWHILE * nbytes > _allowed(device, memory)


def _allowed(device: Device, memory: int | None) -> int:
    """Bytes of a device's memory that there are, or that the user would have taken where it is the host's."""
    if memory is not None and device.info.shares_host_memory:
        return min(device.info.memory, memory)
    return device.info.memory


@dataclass(frozen=True)
class ResidentSubset(SceneHandle):
    """Some splats of a scene that is kept on devices.

    Attributes:
        kept: the scene.
        splats: (n,) int64, their numbers there.
    """

    kept: ResidentScene
    splats: NDArray[np.int64]

    @cached_property
    def scene(self) -> Scene:
        """The same splats on the host, copied when somebody asks for them."""
        return self.kept.scene.subset(self.splats)

    @contextmanager
    def on(self, device: Device) -> Iterator[Drawable]:
        whole = self.kept.found_on(device)
        if isinstance(whole, SceneBuffers):
            # To gather them takes no time; to make ready and upload the splats of the host does.
            with gathered(whole, self.splats) as part:
                yield part
        else:
            yield self.scene


def fits_whole(device: Device, scene: Drawable) -> bool:
    """Whether a whole scene is to lie on a device: on a GPU with memory of its own that it fits, or it does already."""
    if isinstance(scene, SceneBuffers):
        return True
    if device.info.shares_host_memory:
        return False
    return _WHOLE * scene.nbytes <= device.info.memory - device.allocated


@contextmanager
def whole_on_device(device: Device, scene: Drawable) -> Iterator[Drawable]:
    """The same scene where parts are filled from it quickest: on a GPU with memory of its own, if it fits."""
    found: Drawable = scene
    with ExitStack() as stack:
        if not isinstance(scene, SceneBuffers) and fits_whole(device, scene):
            with suppress(DeviceMemoryError):
                found = stack.enter_context(uploaded(device, scene))
        yield found
