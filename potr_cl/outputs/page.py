"""A web page that holds a .potr file and what shows it: one file to send, which opens without a server or a network.

What the page is made of, ``page.html`` beside this module, has the viewer, its decoder and their licences in it;
``python -m tools.make.web`` builds it from web/.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import Coded
from potr_cl.errors import UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.page import FORMAT, scene_in
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Request, Rounded
from potr_cl.outputs.potr import Potr
from potr_cl.raster.scene_buffers import Drawable

TEMPLATE = Path(__file__).with_name("page.html")
_TITLE = "3D scene"


@dataclass(frozen=True)
class Page(Potr):
    """A page (.html).

    Raises:
        UsageError: this installation has no viewer to put into it.
    """

    format: ClassVar[SceneFormat] = FORMAT
    bytes_a_splat: ClassVar[float] = 4 / 3

    def __post_init__(self) -> None:
        if not TEMPLATE.exists():
            raise UsageError("this installation cannot make pages: build their viewer by 'python -m tools.make.web'")

    def losses(self, scene: Scene) -> list[str]:
        """What three.js does not do."""
        return ["how antialiased scenes are to be drawn: its viewer draws them as classic ones"] * scene.antialiased

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """The .potr file, within the page."""
        coded = super().file(scene, rounded, request)
        about = {
            "words": f"{len(coded.order):,} splats, {coded.nbytes / 1e6:.2f} MB",
            "view": _view(scene.means, request),
        }
        return replace(coded, pieces=pieces_of(coded.pieces, about))

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """The scene in a page. Raises DataError if there is none, or it is damaged."""
        return super().read(scene_in(data), trust)

    @contextmanager
    def seen(self, data: bytes, device: Device, trust: bool = False, memory: int | None = None) -> Iterator[Drawable]:
        """See :meth:`potr_cl.outputs.potr.Potr.seen`."""
        with super().seen(scene_in(data), device, trust, memory) as scene:
            yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes by attribute; those of the page are "other"."""
        sums = super().properties(scene_in(data))
        return {**sums, "other": sums.get("other", 0) + len(data) - sum(sums.values())}


def pieces_of(scene: list[bytes], about: dict[str, Any]) -> list[bytes]:
    """The pieces of a page around those of a .potr file."""
    said = json.dumps(about).replace("<", "\\u003c")
    page = TEMPLATE.read_text("utf-8").replace("@title@", _TITLE).replace("@about@", said)
    before, after = page.encode().split(b"@scene@")
    return [before, base64.b64encode(b"".join(scene)), after]


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
