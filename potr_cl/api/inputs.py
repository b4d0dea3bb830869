"""What the functions of this folder take: scenes, cameras, devices and colours, as objects or as a user names them."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from potr_cl.codec.container import MAGIC
from potr_cl.codec.decoder import PotrFile, decode, open_file
from potr_cl.errors import DataError, UsageError
from potr_cl.host.inputs import unchanged
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene

# What reads files, colours and devices is imported where it is needed: to decode takes less time than to import it.
if TYPE_CHECKING:
    from potr_cl.formats.images import Colour
    from potr_cl.opencl.device import Device
    from potr_cl.opencl.discovery import DeviceInfo
    from potr_cl.outputs.output import CodedScene
    from potr_cl.pipeline.encoded import Encoded
    from potr_cl.raster.rules import RasterRules
    from potr_cl.raster.scene_buffers import Drawable, SceneBuffers


_log = logging.getLogger("potr_cl")

#: Files of so many bytes are read for seconds.
_LONG_TO_READ = 1 << 28


class HasScene(Protocol):
    """What a stage or an encode has made."""

    @property
    def scene(self) -> Scene: ...


#: A scene, or what one is taken from: a path of any format that is read, the result of a stage or of an encode, or a
#: .potr file's bytes.
SceneSource: TypeAlias = "Scene | str | os.PathLike[str] | HasScene | bytes"
#: Cameras, or what they are read from.
CamerasSource: TypeAlias = "Sequence[Camera] | str | os.PathLike[str]"
#: A colour as numbers from 0 to 1, or as the command line takes it.
ColourSource: TypeAlias = "str | Sequence[float]"
#: A device, or what it is called: an index, part of a name, "cpu" or "gpu".
DeviceSource: TypeAlias = "Device | DeviceInfo | str | None"


def scene_of(source: SceneSource, trust: bool = False, antialiased: bool | None = None) -> Scene:
    """The scene that a source stands for.

    Args:
        source: see :data:`SceneSource`.
        trust, antialiased: as of :func:`potr_cl.formats.load_scene`.

    Raises:
        UsageError, DataError: as :func:`potr_cl.formats.load_scene`; and a scene in memory has no splats, or some with
            non-finite values.
    """
    if isinstance(source, Scene):
        return _usable(source).rendered(antialiased)
    data = encoded_bytes(source)
    if data is not None:
        return decode(data, **_trusting(trust)).rendered(antialiased)
    scene = getattr(source, "scene", None)
    if isinstance(scene, Scene):
        return scene.rendered(antialiased)
    if isinstance(source, (str, os.PathLike)):
        from potr_cl.formats import load_scene

        if (nbytes := bytes_of_source(source) or 0) >= _LONG_TO_READ:
            _log.info("reading %s, %.1f GB …", source, nbytes / 1e9)
        return load_scene(source, **_trusting(trust)).rendered(antialiased)
    raise UsageError(f"expected a scene or the path of one, not {type(source).__name__}")


def _usable(scene: Scene) -> Scene:
    """A scene in memory, which nobody may have cleaned; mended where no splat has to go, so that numbers stay right."""
    if not len(scene):
        raise DataError("the scene has no splats")
    clean, report = scene.cleaned()
    if report.non_finite:
        many = f"{report.non_finite:,} splats" if report.non_finite > 1 else "a splat"
        raise DataError(f"the scene holds {many} with non-finite values: give scene.cleaned()[0], which is without")
    return clean


@contextmanager
def drawable_of(
    source: SceneSource,
    device: Device,
    trust: bool = False,
    antialiased: bool | None = None,
    coded: CodedScene | None = None,
) -> Iterator[Drawable]:
    """The scene that a source stands for, to be rendered on a device as long as the context lasts.

    A .potr file is decoded into the device's memory, with no scene on the host.

    Args:
        source: see :data:`SceneSource`.
        device: to render on.
        trust, antialiased: as of :func:`scene_of`.
        coded: the source as :func:`coded_scene` has read it, so that it is not read again.

    Raises:
        As :func:`scene_of`.
        DeviceError: the scene does not fit the device.
    """
    if coded is None and not _is_potr(source):
        yield scene_of(source, trust, antialiased)
        return
    read = None if coded is None else coded.data
    with on_device(source, device, trust, antialiased=antialiased, read=read) as buffers:  # type: ignore[arg-type]
        yield buffers


@contextmanager
def drawable_to_judge(
    source: SceneSource,
    device: Device,
    trust: bool = False,
    antialiased: bool | None = None,
    coded: CodedScene | None = None,
) -> Iterator[tuple[Drawable, Scene]]:
    """As :func:`drawable_of`, and a scene on the host by which cameras are judged as by the whole one.

    See :func:`potr_cl.model.agreement.judge_cameras`.
    """
    if coded is None and not _is_potr(source):
        scene = scene_of(source, trust, antialiased)
        yield scene, scene
        return
    from potr_cl.model.sightings import looked_at
    from potr_cl.raster.scene_buffers import SceneBuffers

    with drawable_of(source, device, trust, antialiased, coded) as buffers:
        assert isinstance(buffers, SceneBuffers)
        yield buffers, buffers.read_back(looked_at(len(buffers)))


def coded_scene(source: SceneSource, trust: bool = False) -> CodedScene | None:
    """The .potr file that a source stands for, for other computers to decode; None for anything else.

    Raises:
        UsageError: it cannot be read.
        DataError: it was changed meanwhile.
    """
    if not _is_potr(source):
        return None
    from potr_cl.outputs.output import CodedScene
    from potr_cl.outputs.potr import Potr

    data = encoded_bytes(source)
    if data is None:
        assert isinstance(source, (str, os.PathLike))
        try:
            with Path(source).open("rb") as file, unchanged(source, file):
                data = file.read()
        except OSError as error:
            raise UsageError(f"cannot read '{source}': {error.strerror}") from None
    return CodedScene(Potr(), data, trust)


def _is_potr(source: SceneSource) -> bool:
    if encoded_bytes(source) is not None:
        return True
    return isinstance(source, (str, os.PathLike)) and holds_potr(Path(source))


def on_device(
    source: str | os.PathLike[str] | bytes | Encoded,
    device: Device,
    trust: bool = False,
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
    read: bytes | None = None,
) -> SceneBuffers:
    """The .potr file that a path, bytes or the result of an encode stand for, decoded into a device's memory.

    Args:
        read: the content of the path, where it has been read already.
        source, device, trust, sh_degree, antialiased, threads: as of :func:`potr_cl.decode_to_device`.

    Raises:
        As :func:`potr_cl.decode_to_device`.
    """
    from potr_cl.ondevice.decode import decode_to_device

    def decoded(file: PotrFile) -> SceneBuffers:
        return decode_to_device(file, device, sh_degree, antialiased, threads)

    data = encoded_bytes(source)
    if data is not None:
        return decoded(open_file(data, trust))
    if not isinstance(source, (str, os.PathLike)):
        raise UsageError(f"expected the path of a .potr file, its bytes or an Encoded, not {type(source).__name__}")
    path = os.fspath(source)
    try:
        return decoded(open_file(path if read is None else read, trust))
    except DataError as error:
        raise error if path in str(error) else DataError(f"'{path}': {error}") from None


def encoded_bytes(source: object) -> bytes | None:
    """The bytes of a .potr file, of such bytes or of the result of an encode to one; None for anything else."""
    found = encoded_file(source)
    return found[1] if found is not None and found[0] == ".potr" else None


def encoded_file(source: object) -> tuple[str, bytes] | None:
    """The usual suffix and the bytes of what an encode has made, or of a .potr file's bytes; None for anything else."""
    if isinstance(source, (bytes, bytearray, memoryview)):
        return ".potr", bytes(source)
    # Asked by name: what makes an encode's result takes long to import, and is there if there is one.
    pieces = getattr(source, "pieces", None)
    if not isinstance(pieces, list):
        return None
    options = getattr(source, "options", None)
    return ".potr" if options is None else options.output.suffix, b"".join(pieces)


def cameras_of(source: CamerasSource | None, virtual_views: int | None = None) -> list[Camera] | None:
    """The cameras that a source stands for; None for None.

    Args:
        source: see :data:`CamerasSource`.
        virtual_views: how many views the caller wants placed, which contradicts cameras.

    Raises:
        UsageError: there is no camera, or views are to be placed beside them; and as
            :func:`potr_cl.formats.load_cameras`.
    """
    if source is None:
        return None
    if virtual_views is not None:
        raise placed_beside_cameras("--virtual-views")
    if isinstance(source, (str, os.PathLike)):
        from potr_cl.formats import load_cameras

        return load_cameras(source)
    given: object = source  # in notebooks it may be anything
    cameras = list(given) if isinstance(given, Iterable) else [given]
    if not cameras:
        raise UsageError("the list of cameras is empty: leave it out, and virtual ones are placed")
    for camera in cameras:
        if not isinstance(camera, Camera):
            raise UsageError(f"expected cameras or the path of their file, not {type(camera).__name__}")
    return [camera for camera in cameras if isinstance(camera, Camera)]


def placed_beside_cameras(option: str) -> UsageError:
    """What to raise where cameras are given, and an option asks for views that would be placed without."""
    return UsageError(f"{option} is for scenes without cameras: leave it out, or --cameras")


def device_of(source: DeviceSource) -> Device:
    """The device that a source stands for; the one that should be fastest for None.

    Raises:
        DeviceError: there is none, or it does not work.
    """
    from potr_cl.opencl.device import Device

    return source if isinstance(source, Device) else Device(source)


def colour_of(source: ColourSource) -> Colour:
    """A colour as three numbers.

    Raises:
        UsageError: it is none.
    """
    from potr_cl.formats.images import parse_colour

    text = source if isinstance(source, str) else ",".join(repr(float(part)) for part in source)
    return parse_colour(text)


def rules_of(source: RasterRules | str) -> RasterRules:
    """The rules of a rasterizer, by its name.

    Raises:
        UsageError: there is no rasterizer of this name.
    """
    from potr_cl.raster.rules import RULES

    if not isinstance(source, str):
        return source
    if source not in RULES:
        raise UsageError(f"there are no rules of a rasterizer '{source}': choose {' or '.join(RULES)}")
    return RULES[source]


def bytes_of_source(source: SceneSource) -> int | None:
    """Bytes of the file that a scene comes from, or of all its files (:mod:`potr_cl.formats.registry`); None where it
    comes from none, or whoever reads it will say so.
    """
    encoded = encoded_file(source)
    if encoded is not None:
        return len(encoded[1])
    if not isinstance(source, (str, os.PathLike)):
        return None
    from potr_cl.formats.registry import bytes_of_scene

    return bytes_of_scene(source)


def name_of(source: SceneSource) -> Path:
    """What a scene is called in results: its path, or what it is."""
    if isinstance(source, (str, os.PathLike)):
        return Path(source)
    return Path("(encoded)" if encoded_file(source) is not None else "(scene in memory)")


def chosen_views(
    cameras: Sequence[Camera], views: Sequence[str | int] | str | int | None = None, split: str | None = None
) -> list[Camera]:
    """The views that are asked for by name or by split; without either the test views, or all if there are none.

    Args:
        views: names, or indices from 0 in the cameras' order, or one of these; a view that is named like a number is
            that view.
        split: "train", "test" or "all".

    Raises:
        UsageError: there is no such view, or none is asked for.
    """
    if views is not None and split is not None:
        raise UsageError("give either views or a split")
    if views is not None:
        views = [views] if isinstance(views, (str, int)) else views
        if not len(views):
            raise UsageError("the list of views is empty: name at least one, or leave it out")
        by_name = {camera.name: camera for camera in cameras}
        by_name = {str(index): camera for index, camera in enumerate(cameras)} | by_name
        for name in map(str, views):
            if name not in by_name:
                raise UsageError(
                    f"there is no view '{name}': the cameras hold {len(cameras)} views, from 0 ('{cameras[0].name}') "
                    f"to {len(cameras) - 1} ('{cameras[-1].name}')"
                )
        return list(dict.fromkeys(by_name[str(name)] for name in views))
    if split == "all":
        return list(cameras)
    if split == "train":
        return train_views(cameras)
    if split not in (None, "test"):
        raise UsageError(f"there is no split '{split}': choose train, test or all")
    tests = test_views(cameras)
    if split == "test" and not tests:
        raise UsageError("none of the cameras is a test view: use --split all, or name views with --views")
    return tests or list(cameras)


def holds_potr(path: Path) -> bool:
    """Whether a path is that of a .potr file, whatever it is called; whoever reads it will say what else is wrong."""
    try:
        if not path.is_file():  # a pipe can be read only once
            return False
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except (OSError, ValueError):
        return False


def _trusting(trust: bool) -> dict[str, Any]:
    return {"trust": True} if trust else {}
