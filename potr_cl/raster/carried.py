"""Scenes on their way to other devices: :class:`Carried`, :class:`LentScene`, from one device of this process to
another, and :class:`Excerpt`, some splats on their way to another process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import Indices
from potr_cl.opencl.device import Device
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers


class Carried(ABC):
    """A scene that goes to several devices, each of which makes its own of it."""

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Bytes that travel."""

    @abstractmethod
    def on(self, device: Device) -> AbstractContextManager[Drawable]:
        """What to give to a rasterizer on a device, as long as the context lasts.

        Raises:
            DeviceError: the scene does not fit the device, or the device failed.
        """


@dataclass(frozen=True)
class HostScene(Carried):
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


class LentScene(Carried):
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
class Excerpt:
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

    def gathered(self) -> Scene:
        """A scene of them."""
        return self.scene.subset(self.splats)

    def __reduce__(self) -> tuple[Callable[[Scene], Scene], tuple[Scene]]:
        return _as_it_is, (self.gathered(),)


def _as_it_is(scene: Scene) -> Scene:
    return scene
