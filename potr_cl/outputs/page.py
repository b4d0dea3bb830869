"""A web page as an output: :mod:`potr_cl.formats.scenes.page`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.page import FORMAT, check_viewer, page_around, scene_in, sizes
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Request, Rounded
from potr_cl.outputs.potr import Potr
from potr_cl.raster.scene_buffers import Drawable


@dataclass(frozen=True)
class Page(Potr):
    """A page (.html).

    Attributes:
        title, author: shown on it.

    Raises:
        UsageError: this installation has no viewer to put into it.
    """

    title: str | None = None
    author: str | None = None
    format: ClassVar[SceneFormat] = FORMAT
    bytes_a_splat: ClassVar[float] = 4 / 3

    def __post_init__(self) -> None:
        check_viewer()

    def losses(self, scene: Scene) -> list[str]:
        """What three.js does not do."""
        return ["how antialiased scenes are to be drawn: its viewer draws them as classic ones"] * scene.antialiased

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """The .potr file, within the page."""
        coded = super().file(scene, rounded, request)
        view = _view(scene.means, request)
        return replace(
            coded, pieces=page_around(b"".join(coded.pieces), len(coded.order), self.title, self.author, view)
        )

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """The scene in a page. Raises DataError if there is none, or it is damaged."""
        return super().read(scene_in(data), trust)

    @contextmanager
    def seen(self, data: bytes, device: Device, trust: bool = False, memory: int | None = None) -> Iterator[Drawable]:
        """See :meth:`potr_cl.outputs.potr.Potr.seen`."""
        with super().seen(scene_in(data), device, trust, memory) as scene:
            yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes by attribute; those of the viewer, and what the scene takes more because a page is text."""
        return {**super().properties(scene_in(data)), **sizes(data)}


def _view(means: NDArray[np.float32], request: Request) -> dict[str, Any] | None:
    """Where the page's visitor begins: at the first view, upright as views are on average."""
    if not request.views:
        return None
    camera = request.views[0]
    rotations = np.array([view.rotation for view in request.views])
    position, forward = -camera.rotation.T @ camera.translation, camera.rotation[2]
    up = -rotations[:, 1].mean(axis=0)
    if np.linalg.norm(up) < 0.1:
        up = -camera.rotation[1]
    away = float(np.median(means.astype(np.float64), axis=0) @ forward - position @ forward)
    target = position + forward * (away if away > 0 else 1.0)
    return {
        "position": position.tolist(),
        "target": target.tolist(),
        "up": (up / np.linalg.norm(up)).tolist(),
        "fov": math.degrees(2 * math.atan(camera.height / (2 * camera.fy))),
    }
