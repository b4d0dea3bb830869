"""Pictures of scenes: :func:`render`, and its results, which show themselves in notebooks."""

from __future__ import annotations

import io
import logging
import os
import re
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, overload

import numpy as np

from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    DeviceSource,
    SceneSource,
    colour_of,
    device_of,
    drawable_of,
    drawable_to_judge,
    rules_of,
    scene_of,
)
from potr_cl.api.views import ViewChoices, Viewpoints, describe_views, warn_of_frame
from potr_cl.errors import DataError, DeviceError
from potr_cl.formats.images import Colour, to_8_bits, write_png
from potr_cl.host.atomic_write import make_folder, replacing
from potr_cl.host.inputs import is_device_of_windows
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics_device import Renderer
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import RasterRules
from potr_cl.report.labels import U8, contact_sheet
from potr_cl.views.pictures import rasterizer_for

if TYPE_CHECKING:
    from typing_extensions import Unpack

_log = logging.getLogger("potr_cl")

#: Pixels along a side of each of a preview's pictures.
_PREVIEW = 200
#: Threads that pack pictures, and bytes of pictures that may wait for them.
_PACKING, _WAITING = 16, 1 << 29


class Rendering(NamedTuple):
    """A picture of a scene; in a notebook it shows itself.

    Attributes:
        image: (H, W, 3) float32, linear in the scene's colours, not clamped above.
        transmittance: (H, W) float32, the share of the background that shows through.
    """

    image: FloatArray
    transmittance: FloatArray

    def __repr__(self) -> str:
        height, width = self.transmittance.shape
        return f"Rendering({width} x {height} pixels, {100 * float(self.transmittance.mean()):.0f} % background)"

    @property
    def pixels(self) -> U8:
        """(H, W, 3) uint8, clamped."""
        return to_8_bits(self.image)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the picture as PNG, whole or not at all.

        Raises:
            UsageError: it cannot be written there.
        """
        with replacing(path) as file:
            write_png(file, self.pixels)

    def _repr_png_(self) -> bytes:
        return png_bytes(self.pixels)


@dataclass(frozen=True, repr=False)
class Renderings(Sequence[Rendering]):
    """Pictures of a scene from several views, in their order; in a notebook they show themselves on one page.

    Attributes:
        cameras: the views.
        pictures: one for each.
        note: what views were placed, where no cameras were given; else nothing.
    """

    cameras: list[Camera]
    pictures: list[Rendering]
    note: str = ""

    def __repr__(self) -> str:
        first, last = self.cameras[0], self.cameras[-1]
        views = f"{len(self)} views from '{first.name}' to '{last.name}'" if len(self) > 1 else f"view '{first.name}'"
        return f"Renderings({views}, {first.width} x {first.height} pixels)"

    def __len__(self) -> int:
        return len(self.pictures)

    @overload
    def __getitem__(self, place: int | str) -> Rendering: ...
    @overload
    def __getitem__(self, place: slice) -> list[Rendering]: ...
    def __getitem__(self, place: int | str | slice) -> Rendering | list[Rendering]:
        """A picture by its place or by the name of its view."""
        if not isinstance(place, str):
            return self.pictures[place]
        for camera, picture in zip(self.cameras, self.pictures, strict=True):
            if camera.name == place:
                return picture
        raise KeyError(place)

    def sheet(self, heading: str = "") -> U8:
        """All pictures small on one page, (H, W, 3) uint8, each under the name of its view."""
        pairs = zip(self.cameras, self.pictures, strict=True)
        return contact_sheet([(picture.pixels, camera.name) for camera, picture in pairs], heading)

    def save(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write each picture as PNG into a folder, which is made if need be; named after the views.

        Returns:
            The files' paths.

        Raises:
            UsageError: the folder cannot be made or written to.
            DataError: two views would have one file.
        """
        paths = picture_files(Path(folder), self.cameras)
        make_folder(Path(folder))
        for path, picture in zip(paths, self.pictures, strict=True):
            picture.save(path)
        return paths

    def _repr_png_(self) -> bytes:
        return png_bytes(self.sheet())


@overload
def render(
    scene: SceneSource,
    cameras: Camera,
    device: DeviceSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    *,
    trust: bool = False,
    antialiased: bool | None = None,
) -> Rendering: ...
@overload
def render(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    device: DeviceSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    *,
    output: str | os.PathLike[str] | None = None,
    trust: bool = False,
    antialiased: bool | None = None,
    **views: Unpack[ViewChoices],
) -> Renderings: ...
def render(
    scene: SceneSource,
    cameras: Camera | CamerasSource | None = None,
    device: DeviceSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    *,
    output: str | os.PathLike[str] | None = None,
    trust: bool = False,
    antialiased: bool | None = None,
    **views: Unpack[ViewChoices],
) -> Rendering | Renderings:
    """Render a scene, as the command ``render`` does.

    For very many views keep a :class:`potr_cl.raster.rasterizer.Rasterizer`: the pictures of this function are all in
    memory at the end.

    Args:
        scene: to look at, or its file.
        cameras: one camera, several, or their file; None: views are placed.
        device: to render on, or what it is called; the one that should be fastest by default.
        rules: of the rasterizer to follow: inria, the original's, or gsplat.
        background: R, G, B from 0 to 1, or a colour's name.
        output: a folder to write the pictures to as well, as PNG files named after their views.
        trust, antialiased: as of :func:`potr_cl.load_scene`.
        views: ``views``, names or indices of the views to render, all by default; ``split``, only "train" or "test"
            views. Without cameras ``virtual_views``, how many views to place, 8 by default; ``turntable``, so many
            from a circle around the scene instead; ``up``, which way is up in them: "x", "y", "z", "-x", "-y", "-z",
            three numbers, by default a guess; ``size``, pixels along a side of their pictures, 800 by default.

    Returns:
        A :class:`Rendering`, the image and the transmittance, for one camera; else :class:`Renderings`.

    Raises:
        UsageError: an option is out of range, or contradicts another.
        DataError: a file is damaged.
        DeviceError: a view does not fit the device, or the device failed.
    """
    colour, wanted = colour_of(background), rules_of(rules)
    points = Viewpoints(**views)
    if isinstance(cameras, Camera):
        opened = device_of(device)
        with (
            drawable_of(scene, opened, trust, antialiased) as drawable,
            Rasterizer(opened, drawable, wanted, colour) as rasterizer,
        ):
            return Rendering(*rasterizer.render(cameras))
    views_of = _Views(scene, cameras, points, device_of(device), trust, antialiased)
    if output is not None:
        picture_files(Path(output), views_of.chosen)  # names that cannot be written are reported before the work
    with views_of.rasterizer(wanted, colour) as rasterizer:
        pictures = [Rendering(*rasterizer.render(camera)) for camera in views_of.chosen]
    result = Renderings(views_of.chosen, pictures, views_of.note)
    if output is not None:
        result.save(output)
    return result


def render_to_files(
    scene: SceneSource,
    output: Path,
    cameras: CamerasSource | None = None,
    device: DeviceSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    *,
    points: Viewpoints,
    trust: bool = False,
    antialiased: bool | None = None,
    check: Callable[[Sequence[Camera], Sequence[Path]], None] = lambda cameras, files: None,
    progress: Callable[[str, float], None] = lambda stage, done: None,
) -> str:
    """The same, but few pictures are in memory at a time; for the command ``render``.

    Args:
        output: the folder.
        points: which views, and how to look at the scene without cameras.
        check: called with all cameras and the files that will be written, before any is.
        progress: called with what is done and the part of it that is done.

    Returns:
        What was done, in a line.
    """
    colour, wanted = colour_of(background), rules_of(rules)
    of = _Views(scene, cameras, points, device_of(device), trust, antialiased)
    if of.note:
        _log.info("no --cameras given: %s", of.note)
    files = picture_files(output, of.chosen)
    check(of.there, files)
    make_folder(output)
    stage = f"rendering {len(of.chosen)} view{'s' if len(of.chosen) > 1 else ''}"
    with of.rasterizer(wanted, colour, warn=cameras is not None) as rasterizer:
        progress(stage, 0.0)
        for done, _ in enumerate(written_pictures(rasterizer, of.chosen, files), 1):
            progress(stage, done / len(of.chosen))
    return f"{len(of.chosen)} image{'s' if len(of.chosen) > 1 else ''}, rendered on {of.device.info}"


class _Views:
    """A scene and the views that are rendered of it.

    Attributes:
        there: all views, given or placed.
        chosen: those that are rendered.
        note: what views were placed, in a line, if any were.
    """

    def __init__(
        self,
        scene: SceneSource,
        cameras: CamerasSource | None,
        points: Viewpoints,
        device: Device,
        trust: bool,
        antialiased: bool | None,
    ) -> None:
        given = points.given(cameras)
        self.device, self._trust, self._antialiased = device, trust, antialiased
        # Views are placed in a scene that the host has.
        self._source = scene if given is not None else scene_of(scene, trust, antialiased)
        self.there = given or points.placed(scene_of(self._source), device)
        self.note = "" if given else describe_views(self.there)
        self.chosen = points.chosen(self.there, "all")

    @contextmanager
    def rasterizer(self, rules: RasterRules, background: Colour, warn: bool = False) -> Iterator[Renderer]:
        """What renders them, as long as the context lasts; ``warn``: of views that do not fit the scene."""
        how = self._source, self.device, self._trust, self._antialiased
        with ExitStack() as stack:
            if warn:
                drawable, scene = stack.enter_context(drawable_to_judge(*how))
                warn_of_frame(self._source, scene, self.chosen)
            else:
                drawable = stack.enter_context(drawable_of(*how))
            rasterizer = rasterizer_for(self.device, drawable, self.chosen, rules, background)
            stack.callback(rasterizer.close)
            yield rasterizer


def preview(scene: SceneSource) -> bytes | None:
    """A small picture of a scene from four sides, as the bytes of a PNG file: what notebooks show of it.

    None where no device renders it: a notebook then shows the line of text that the scene is anyway.
    """
    what = scene_of(scene)
    try:
        pictures = render(what, turntable=4, size=_PREVIEW)
    except DeviceError:
        return None
    return png_bytes(pictures.sheet(repr(what)))


def picture_files(folder: Path, cameras: Sequence[Camera]) -> list[Path]:
    """The PNG file of each view in a folder; views' names, which others chose, do not lead out of it.

    Raises:
        DataError: two views would have one file.
    """
    names = [file_name(camera.name) + ".png" for camera in cameras]
    if len(set(names)) < len(names):
        raise DataError("two views of the cameras would be written to one file: choose among them with --views")
    return [folder / name for name in names]


def file_name(view: str, windows: bool = os.name == "nt") -> str:
    """A view's name as that of a file, without a suffix.

    Args:
        view: the name.
        windows: whether the file is for Windows, where some characters stand for other things than themselves, and
            some names for devices, whatever suffix they have.
    """
    name = view.replace("/", "_")
    if windows:
        name = re.sub(r'[\\<>:"|?*]', "_", name)
        if is_device_of_windows(name):
            name = f"_{name}"
    return name


def written_pictures(rasterizer: Renderer, cameras: Sequence[Camera], paths: Sequence[Path]) -> Iterator[Path]:
    """Render views and write them, so that few are in memory at a time; yields what is written, in order.

    To pack a picture takes ten times as long as a GPU takes to render it: threads do that while others are rendered.

    Raises:
        UsageError: a file cannot be written.
        DeviceError: a view does not fit the device, or the device failed.
    """
    packed: deque[tuple[Path, Future[None]]] = deque()

    def written(most: int) -> Iterator[Path]:
        while len(packed) > most:
            path, done = packed.popleft()
            done.result()
            yield path

    with thread_pool(min(os.cpu_count() or 1, _PACKING)) as pool:
        for camera, path in zip(cameras, paths, strict=True):
            if 16 * camera.width * camera.height > _WAITING:
                yield from written(0)
                _write_huge(rasterizer, camera, path)
                yield path
                continue
            rendering = Rendering(*rasterizer.render(camera))
            packed.append((path, pool.submit(rendering.save, path)))
            nbytes = rendering.image.nbytes + rendering.transmittance.nbytes
            yield from written(min(_PACKING, _WAITING // max(nbytes, 1)))
        yield from written(0)


def _write_huge(rasterizer: Renderer, camera: Camera, path: Path) -> None:
    """The same of a picture that takes gigabytes: on the host it is there in 8 bits only."""
    pixels = np.empty((camera.height, camera.width, 3), np.uint8)
    first = 0
    for strip in rasterizer.strips(camera):
        pixels[first : first + len(strip)] = to_8_bits(strip)
        first += len(strip)
    with replacing(path) as file:
        write_png(file, pixels)


def png_bytes(pixels: U8) -> bytes:
    """(H, W, 3) uint8 as the bytes of a PNG file."""
    file = io.BytesIO()
    write_png(file, pixels)
    return file.getvalue()
