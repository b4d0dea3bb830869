"""The package's own files as an output, with steps that q sets, and entropy coders; alone, and in a web page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.blocks import AnyGeometry, GeometryOfBlocks, quantise
from potr_cl.codec.decoder import PotrFile, decode, open_file
from potr_cl.codec.encoder import Coded, code_scene
from potr_cl.codec.geometry import Geometry
from potr_cl.codec.levels import joined_levels
from potr_cl.codec.quantisers import QUANTISERS
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import ORDER, SH, Property
from potr_cl.errors import DeviceError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import page
from potr_cl.formats.scenes.page import POTR
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.ondevice.decode import decode_to_device
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import ColourGrid, LevelErrors, Output, Request, Rounded
from potr_cl.raster.resident import large_for
from potr_cl.raster.scene_buffers import Drawable

_NAMES = {
    **dict.fromkeys(ORDER[: ORDER.index(Property.STEPS)], "position"),
    Property.SCALE: "scale",
    Property.ROTATION: "rotation",
    Property.OPACITY: "opacity",
    Property.STEPS: "colour: precision",
    Property.SH0: "colour: DC",
    **dict.fromkeys(SH[1:], "colour: AC"),
}


@dataclass(frozen=True)
class Potr(Output):
    """A .potr file: :mod:`potr_cl.codec`. AC coefficients are rounded to steps finer than one sees."""

    format: ClassVar[SceneFormat] = POTR
    choices: ClassVar[frozenset[str]] = frozenset(
        {"entropy", "zstd_level"} | {each.name for each in fields(HyperParameters)}
    )
    steps: ClassVar[bool] = True
    fixes_ac: ClassVar[bool] = True
    levels: ClassVar[int | str | None] = 1

    def geometry(self, scene: Scene, request: Request) -> AnyGeometry:
        """See :func:`potr_cl.codec.blocks.quantise`."""
        with thread_pool(request.threads) as pool:
            return quantise(scene, request.parameters, request.views, pool.map)

    def on_grid(self, request: Request) -> bool:
        """With the quantiser that has steps of each splat."""
        return QUANTISERS[request.parameters.quantiser].colour_steps

    def colour_grid(self, rounded: Rounded, effects: FloatArray, request: Request) -> tuple[Rounded, ColourGrid]:
        """Fit the steps of colours to each splat."""
        assert isinstance(rounded, (Geometry, GeometryOfBlocks))
        geometry = rounded.with_steps(effects)
        return geometry, ColourGrid.of(geometry)

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.codec.encoder.code_scene`."""
        assert rounded is None or isinstance(rounded, (Geometry, GeometryOfBlocks))
        return code_scene(
            scene,
            request.parameters,
            request.views,
            request.metadata,
            request.entropy,
            request.threads,
            request.progress,
            rounded,
        )

    def levelled(self, files: Sequence[bytes], errors: LevelErrors, read: Callable[[int], Scene]) -> list[bytes]:
        """See :func:`potr_cl.codec.levels.joined_levels`."""
        opened = [open_file(data, trust=True) for data in files]
        return joined_levels(opened, [errors.of_level(level) for level in range(len(files))])

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """See :func:`potr_cl.codec.decoder.decode`."""
        return decode(data, trust)

    @contextmanager
    def seen(self, data: bytes, device: Device, trust: bool = False, memory: int | None = None) -> Iterator[Drawable]:
        """See :func:`potr_cl.ondevice.decode.decode_to_device`.

        An ordinary scene where it does not fit the device; or where this is a CPU and has little memory: views are
        drawn from what they show of it then.
        """
        file = open_file(data, trust)
        with ExitStack() as stack:
            scene: Drawable | None = None
            of_host = device.info.shares_host_memory
            if memory is None or not (of_host and large_for(device, _decoded_bytes(file), memory)):
                with suppress(DeviceError):
                    scene = stack.enter_context(decode_to_device(file, device))
            if scene is None:
                with bounded(memory):
                    scene = file.scene()
            yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes by attribute; the header and the metadata are "other"."""
        names = ("position", "scale", "rotation", "opacity", "colour: DC", "colour: AC", "colour: precision", "other")
        sums = dict.fromkeys(names, 0)
        for section in (section for block in open_file(data, trust=True).blocks for section in block.sections):
            sums[_NAMES.get(section.kind, "other") if section.kind else "other"] += section.stored_bytes
        sums["other"] += len(data) - sum(sums.values())
        return {name: nbytes for name, nbytes in sums.items() if nbytes}


def _decoded_bytes(file: PotrFile) -> int:
    """Of the scene that a file holds."""
    return 4 * file.header.splats * (11 + 3 * SH_COEFFICIENTS[file.header.sh_degree])


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
    format: ClassVar[SceneFormat] = page.FORMAT
    bytes_a_splat: ClassVar[float] = 4 / 3
    levels: ClassVar[int | str | None] = None

    def __post_init__(self) -> None:
        page.check_viewer()

    def losses(self, scene: Scene) -> list[str]:
        """What three.js does not do."""
        return ["how antialiased scenes are to be drawn: its viewer draws them as classic ones"] * scene.antialiased

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """The .potr file, within the page."""
        coded = super().file(scene, rounded, request)
        view = _view(scene.means, request)
        return replace(
            coded, pieces=page.page_around(b"".join(coded.pieces), len(coded.order), self.title, self.author, view)
        )

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """The scene in a page. Raises DataError if there is none, or it is damaged."""
        return super().read(page.scene_in(data), trust)

    @contextmanager
    def seen(self, data: bytes, device: Device, trust: bool = False, memory: int | None = None) -> Iterator[Drawable]:
        """See :meth:`potr_cl.outputs.potr.Potr.seen`."""
        with super().seen(page.scene_in(data), device, trust, memory) as scene:
            yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes by attribute; those of the viewer, and what the scene takes more because a page is text."""
        return {**super().properties(page.scene_in(data)), **page.sizes(data)}


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
