"""What is attacked: FORMATS, a line each, with what makes and changes files, what reads them, what a file may cost."""

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
)
from tools.stress.hostile.changes import Files

MIB = 1 << 20
#: Bytes that a pixel of a photograph may take while it is read.
A_PIXEL = 64
#: Good files that are read before changed ones.
_GOOD = 30


class WrongResult(Exception):
    """What a reader gave is not what it promises."""


@dataclasses.dataclass(frozen=True)
class Format:
    """A kind of input.

    Attributes:
        make: makes a small good file, or several that belong together.
        change: changes them.
        read: reads the first of them, as the package's user does. Raises WrongResult if what comes out cannot be right.
        constant, a_byte: memory that reading may take, in bytes: so much for any file, and so much for each byte of it.
        beyond: bytes besides that a certain file may take.
        twice: what was read is read again with other garbage in memory that nobody has written to: results that differ
            show that a library looked there.
    """

    make: Callable[[Random], Files]
    change: Callable[[Files, Random], Files]
    read: Callable[[Path], Any]
    constant: int
    a_byte: int
    beyond: Callable[[Path], int] = lambda path: 0
    twice: bool = False

    def good(self) -> list[Files]:
        """Some as they should be."""
        return [self.make(Random(seed)) for seed in range(_GOOD)]

    def changed(self, rng: Random) -> Files:
        return self.change(self.make(rng), rng)

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
    if len(scene) < 1 or any(len(array) != len(scene) for array in scene.arrays):
        raise WrongResult("a scene without splats, or with some in one array only")
    if not all(np.isfinite(array).all() for array in scene.arrays):
        raise WrongResult("values that are not finite")
    return scene


def parts_of(result: Any) -> list[bytes]:
    """What was read, to compare it with another reading."""
    if isinstance(result, Scene):
        return [array.tobytes() for array in result.arrays]
    return [repr(result).encode()]


Make = Callable[[Random], Files]
Change = Callable[[Files, Random], Files]


def _scene(make: Make, change: Change, constant: int, a_byte: int, read: Callable[[Path], Any] = read_scene) -> Format:
    return Format(make, change, read, constant * MIB, a_byte, twice=True)


def _cameras(make: Make, change: Change) -> Format:
    return Format(make, change, read_cameras, 32 * MIB, 128)


def _picture(make: Make, change: Change) -> Format:
    return Format(make, change, read_picture, MIB, 64, beyond=bytes_of_pixels)


#: By name. docs/security.md states the costs.
FORMATS: dict[str, Format] = {
    "potr": _scene(potr_files.potr, potr_files.changed, 64, 8192, read_potr),
    "html": _scene(potr_files.page, potr_files.changed_page, 64, 8192),
    "ply": _scene(ply_files.plain, ply_files.changed, 32, 64),
    "compressed.ply": _scene(ply_files.compressed, ply_files.changed, 32, 64),
    "spz": _scene(splat_files.spz, splat_files.changed_spz, 64, 2048),
    "sog": _scene(sog_files.sog, sog_files.changed, 64, 2048),
    "sog-folder": _scene(sog_files.folder, sog_files.FOLDER.changed, 64, 2048),
    "sog-levels": _scene(sog_files.levels, sog_files.FOLDER.changed, 64, 2048),
    "glb": _scene(gltf_files.binary, gltf_files.changed_binary, 64, 2048),
    "gltf": _scene(gltf_files.text, gltf_files.TEXT.changed, 64, 2048),
    "splat": _scene(splat_files.splat, splat_files.SPLAT.changed, 32, 64),
    "ksplat": _scene(splat_files.ksplat, splat_files.KSPLAT.changed, 32, 64),
    "ply.gz": _scene(splat_files.gzipped_ply, splat_files.changed_gzip, 64, 4096),
    "cameras.json": _cameras(camera_files.cameras, camera_files.VIEWS.changed),
    "transforms.json": _cameras(camera_files.transforms, camera_files.FRAMES.changed),
    "colmap-binary": _cameras(camera_files.colmap_binary, camera_files.MODEL.changed),
    "colmap-text": _cameras(camera_files.colmap_text, camera_files.MODEL.changed),
    "png": _picture(picture_files.png, picture_files.changed_png),
    "jpeg": _picture(picture_files.jpeg, picture_files.JPEG.changed),
    "webp": _picture(picture_files.webp, picture_files.changed_webp),
}
