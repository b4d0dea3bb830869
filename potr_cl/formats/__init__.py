"""Files of scenes and cameras, in the formats that :mod:`potr_cl.formats.registry` lists: one module a format."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import DataError, UsageError
from potr_cl.formats import registry, streams
from potr_cl.formats.cameras.view_files import read_json
from potr_cl.host.inputs import refuse_lfs_pointer
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene

_log = logging.getLogger("potr_cl")

#: A picture so many times as wide as its focal length covers 150 degrees, more than any pinhole is used for.
_WIDE = 7.5

__all__ = ["load_cameras", "load_scene", "read_cameras", "read_scene", "save_scene", "scene_writer"]


def load_scene(path: str | os.PathLike[str], trust: bool = False, antialiased: bool | None = None) -> Scene:
    """Read a trained scene; its name tells the format, the content where formats share an extension.

    Args:
        path: of a file in one of ``registry.SCENE_FORMATS``, or one that is gzipped (".ply.gz"), or of a folder that
            holds a scene in several files (SOG). A .potr file is decoded. Where a scene has levels of detail, the
            finest is read, or the one whose number stands behind the path: "scene/lod-meta.json#1".
        trust: whether the file may hold more splats a byte than a real scene has. Without, memory and time are in
            proportion to its size.
        antialiased: whether the scene was trained with antialiasing and is to be rendered so; None: as the file says,
            which those of gsplat and nerfstudio do not.

    Raises:
        UsageError: the file cannot be opened, or its extension is unknown.
        DataError: its content is damaged, or it holds too many splats for its size.
    """
    with np.errstate(all="ignore"), streams.plain(Path(path), trust) as file:
        return registry.format_of(file).load(file, trust).rendered(antialiased)


def scene_writer(path: str | os.PathLike[str], **choices: Any) -> Callable[[Scene], None]:
    """What writes a scene to ``path`` in the format that its suffixes tell; nothing is written yet.

    Args:
        path: of the file to write.
        choices: of the format, those that are not None: ``version``, where it has several; ``title`` and ``author`` of
            a page; ``source``, the file that the scene was read from, where it matters to the format.

    Raises:
        UsageError: no format that is written has these suffixes (a .potr file is what an encoder makes), or it has no
            such choice or version.
    """
    path = Path(path)
    entry = registry.written_format(path)
    if "source" not in entry.choices:
        choices.pop("source", None)
    given = {name: value for name, value in choices.items() if value is not None}
    version = given.get("version")
    if version is not None and version not in entry.versions:
        known = registry.listed([str(each) for each in sorted(entry.versions)])
        has = f"is written in version {known}" if known else "has no versions to choose from"
        raise UsageError(f"'{path}': {entry.name} {has}, not {version}")
    for name in given.keys() - {"version", *entry.choices}:
        raise UsageError(f"'{path}': {entry.name} has no {name} to choose")
    assert entry.save is not None
    return partial(entry.save, path, **given)


def save_scene(path: str | os.PathLike[str], scene: Scene, **choices: Any) -> None:
    """Write a scene in the format that the suffixes of ``path`` tell.

    Args:
        path: of the file to write.
        scene: to write.
        choices: see :func:`scene_writer`.

    Raises:
        UsageError: see :func:`scene_writer`; or ``path`` cannot be written to.
        PotrError: the format cannot hold the scene, or the system failed to write.
    """
    scene_writer(path, **choices)(scene)


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read the views of a scene; the content tells the format.

    Args:
        path: of a file in one of ``registry.CAMERA_FORMATS``, or of a folder that holds such files. A COLMAP model may
            also be in the folder's ``sparse/0``, ``sparse`` or ``0``.

    Returns:
        The views with their split into training and test views; at least one.

    Raises:
        UsageError: there is nothing at ``path``, or it is of no known kind.
        DataError: its content is damaged.
    """
    path = Path(path)
    refuse_lfs_pointer(path)
    try:
        with np.errstate(all="ignore"):  # what overflows is dropped or refused by name
            cameras = _from_folder(path) if path.is_dir() else _from_file(path)
    except OSError as error:
        raise UsageError(f"cannot read '{error.filename or path}': {error.strerror or error}") from error
    _tell_of_wide_views(path, cameras)
    return cameras


def _tell_of_wide_views(path: Path, cameras: list[Camera]) -> None:
    """Log one line if views are wider than any pinhole's: their focal lengths are hardly pixels."""

    def across(camera: Camera) -> float:
        return max(camera.width / camera.fx, camera.height / camera.fy)

    wide = [camera for camera in cameras if across(camera) > _WIDE]
    if wide:
        one = max(wide, key=across)
        degrees = 2 * math.degrees(math.atan(across(one) / 2))
        _log.warning(
            "'%s': %d of %d views are very wide, up to %.0f degrees: are their focal lengths in pixels of %d x %d?",
            path, len(wide), len(cameras), degrees, one.width, one.height,
        )  # fmt: skip


def _from_file(path: Path) -> list[Camera]:
    suffix = path.suffix.lower()
    content = read_json(path) if suffix == ".json" else None
    for entry in registry.CAMERA_FORMATS:
        if suffix in entry.suffixes and entry.recognises(path, content):
            return entry.load(path, content)
    if suffix == ".json":
        raise DataError(f"'{path}' is neither {registry.json_cameras()}")
    if not path.exists():
        raise UsageError(f"there is no file or folder '{path}'")
    raise UsageError(f"'{path}': unknown kind of cameras, expected {registry.cameras_read()}")


def _from_folder(folder: Path) -> list[Camera]:
    """The folder itself is searched for every format before the subfolders of any."""
    for entry in registry.CAMERA_FORMATS:
        if entry.is_in(folder):
            return entry.load_folder(folder)
    for entry in registry.CAMERA_FORMATS:
        for subfolder in entry.subfolders:
            if entry.is_in(folder / subfolder):
                return entry.load_folder(folder / subfolder)
    raise UsageError(f"the folder '{folder}' has no cameras, expected {registry.cameras_read()}")


#: The same under the names that go with what the readers' messages say; neither name is better than the other.
read_scene, read_cameras = load_scene, load_cameras
