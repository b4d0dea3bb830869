"""What is attacked: FORMATS, a line each, with what makes changed files, what reads them, and what a file may cost."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from potr_cl.codec.decoder import open_file
from potr_cl.errors import PotrError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import image_size, read_ground_truth
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.report.file import file_report, format_report
from tools.stress.hostile import (
    camera_files,
    gltf_files,
    picture_files,
    ply_files,
    potr_files,
    sog_files,
    splat_files,
    spz_files,
)  # fmt: skip
from tools.stress.hostile.changes import Files

MIB = 1 << 20
#: Bytes that a pixel of a photograph may take while it is read.
A_PIXEL = 64


class WrongResult(Exception):
    """What a reader gave is not what it promises."""


@dataclasses.dataclass(frozen=True)
class Format:
    """A kind of input.

    Attributes:
        good: files as they should be, each with those that belong to it: what the changed ones are made of.
        changed: makes a changed file, or several that belong together.
        read: reads the first of them, as the package's user does. Raises WrongResult if what comes out cannot be right.
        constant, a_byte: memory that reading may take, in bytes: so much for any file, and so much for each byte of it.
        beyond: bytes besides that a certain file may take.
        twice: what was read is read again with other garbage in memory that nobody has written to: results that differ
            show that a library looked there.
    """

    good: Callable[[], list[Files]]
    changed: Callable[[Random], Files]
    read: Callable[[Path], Any]
    constant: int
    a_byte: int
    beyond: Callable[[Path], int] = lambda path: 0
    twice: bool = False

    def allowance(self, path: Path, size: int) -> int:
        """Bytes that reading a file of some size may take."""
        return self.constant + self.a_byte * size + self.beyond(path)


def read_potr(path: Path) -> Scene:
    """What the commands decode and info do with a file."""
    file = open_file(path)
    scene = file.scene(threads=1)
    report = file_report(file)
    json.dumps(report, allow_nan=False).encode()
    format_report(report).encode()
    return _checked_scene(scene)


def read_scene(path: Path) -> Scene:
    """What every command does with a scene."""
    return _checked_scene(load_scene(path))


def read_cameras(path: Path) -> list[Camera]:
    """What every command does with cameras."""
    cameras = load_cameras(path)
    if not cameras:
        raise WrongResult("no cameras")
    for camera in cameras:
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.rotation.ravel(), *camera.translation.ravel())
        if not np.isfinite(numbers).all() or not (0 < camera.width <= 1 << 16 and 0 < camera.height <= 1 << 16):
            raise WrongResult("a camera of impossible numbers")
        if not camera.name.isprintable():
            raise WrongResult("a name that is not printable")
    return cameras


def read_picture(path: Path) -> Any:
    """What is done with a photograph."""
    width, height = image_size(path)
    pixels = read_ground_truth(path)
    if pixels.shape != (height, width, 3) or not (pixels.min() >= 0 and pixels.max() <= 1):
        raise WrongResult("pixels that are none")
    return pixels


def bytes_of_pixels(path: Path) -> int:
    """What the pixels of a picture may take that is not refused for its header."""
    try:
        width, height = image_size(path)
    except PotrError:
        return 0
    return A_PIXEL * width * height


def _checked_scene(scene: Scene) -> Scene:
    arrays = (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh)
    if len(scene) < 1 or any(len(array) != len(scene) for array in arrays):
        raise WrongResult("a scene without splats, or with some in one array only")
    if not all(np.isfinite(array).all() for array in arrays):
        raise WrongResult("values that are not finite")
    return scene


def parts_of(result: Any) -> list[bytes]:
    """What was read, to compare it with another reading."""
    if isinstance(result, Scene):
        arrays = (result.means, result.log_scales, result.quaternions, result.opacity_logits, result.sh)
        return [array.tobytes() for array in arrays]
    return [repr(result).encode()]


def _scene(
    good: Callable[[], list[Any]], changed: Callable[[Random], Any], constant: int, a_byte: int, name: str = "",
    read: Callable[[Path], Any] = read_scene,
) -> Format:  # fmt: skip
    """A format of scenes; with a name: of files that stand alone."""
    return _format(good, changed, name, read, constant * MIB, a_byte, twice=True)


def _cameras(good: Callable[[], list[Files]], changed: Callable[[Random], Files]) -> Format:
    return Format(good, changed, read_cameras, 32 * MIB, 128)


def _picture(good: Callable[[], list[bytes]], changed: Callable[[Random], bytes], name: str) -> Format:
    return _format(good, changed, name, read_picture, MIB, 64, beyond=bytes_of_pixels)


def _format(good: Callable[[], Any], changed: Callable[[Random], Any], name: str, *others: Any, **more: Any) -> Format:
    if not name:
        return Format(good, changed, *others, **more)
    return Format(lambda: [{name: data} for data in good()], lambda rng: {name: changed(rng)}, *others, **more)


#: By name. docs/security.md states the costs.
FORMATS: dict[str, Format] = {
    "potr": _scene(potr_files.originals, potr_files.changed, 64, 8192, "a.potr", read_potr),
    "html": _scene(potr_files.page_originals, potr_files.changed_page, 64, 8192, "a.html"),
    "ply": _scene(ply_files.plain_originals, ply_files.changed_plain, 32, 64, "a.ply"),
    "compressed.ply": _scene(ply_files.compressed_originals, ply_files.changed_compressed, 32, 64, "a.compressed.ply"),
    "spz": _scene(spz_files.originals, spz_files.changed, 64, 2048, "a.spz"),
    "sog": _scene(sog_files.originals, sog_files.changed, 64, 2048, "a.sog"),
    "sog-folder": _scene(sog_files.folder_originals, sog_files.changed_folder, 64, 2048),
    "sog-levels": _scene(sog_files.level_originals, sog_files.changed_levels, 64, 2048),
    "glb": _scene(gltf_files.originals, gltf_files.changed, 64, 2048),
    "gltf": _scene(gltf_files.gltf_originals, gltf_files.changed_gltf, 64, 2048),
    "splat": _scene(splat_files.splat_originals, splat_files.changed_splat, 32, 64, "a.splat"),
    "ksplat": _scene(splat_files.ksplat_originals, splat_files.changed_ksplat, 32, 64, "a.ksplat"),
    "ply.gz": _scene(spz_files.gzip_originals, spz_files.changed_gzip, 64, 4096, "a.ply.gz"),
    "cameras.json": _cameras(camera_files.cameras_originals, camera_files.changed_cameras),
    "transforms.json": _cameras(camera_files.transforms_originals, camera_files.changed_transforms),
    "colmap-binary": _cameras(camera_files.colmap_binary_originals, camera_files.changed_colmap_binary),
    "colmap-text": _cameras(camera_files.colmap_text_originals, camera_files.changed_colmap_text),
    "png": _picture(picture_files.good_pngs, picture_files.changed_png, "a.png"),
    "jpeg": _picture(picture_files.jpeg_originals, picture_files.changed_jpeg, "a.jpg"),
    "webp": _picture(picture_files.webp_originals, picture_files.changed_webp, "a.webp"),
}
