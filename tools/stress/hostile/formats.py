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
    gzip_files,
    picture_files,
    ply_files,
    potr_files,
    sog_files,
    sog_folder_files,
    splat_files,
    spz_files,
)

#: Files that belong together, by their names relative to one folder; the first is what is read.
Files = dict[str, bytes]

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


def _single(
    name: str, good: Callable[[], list[bytes]], changed: Callable[[Random], bytes], *others: Any, **more: Any
) -> Format:
    """A format whose files stand alone."""
    return Format(lambda: [{name: data} for data in good()], lambda rng: {name: changed(rng)}, *others, **more)


def _picture(name: str, good: Callable[[], list[bytes]], changed: Callable[[Random], bytes]) -> Format:
    return _single(name, good, changed, read_picture, MIB, 64, bytes_of_pixels)


#: By name. docs/security.md states the costs.
FORMATS: dict[str, Format] = {
    "potr": _single("a.potr", potr_files.originals, potr_files.changed, read_potr, 64 * MIB, 8192, twice=True),
    "ply": _single("a.ply", ply_files.plain_originals, ply_files.changed_plain, read_scene, 32 * MIB, 64, twice=True),
    "compressed.ply": _single(
        "a.compressed.ply", ply_files.compressed_originals, ply_files.changed_compressed, read_scene, 32 * MIB, 64,
        twice=True,
    ),
    "spz": _single("a.spz", spz_files.originals, spz_files.changed, read_scene, 64 * MIB, 2048, twice=True),
    "sog": _single("a.sog", sog_files.originals, sog_files.changed, read_scene, 64 * MIB, 2048, twice=True),
    "sog-folder": Format(
        sog_folder_files.originals, sog_folder_files.changed, read_scene, 64 * MIB, 2048, twice=True
    ),
    "sog-levels": Format(
        sog_folder_files.level_originals, sog_folder_files.changed_levels, read_scene, 64 * MIB, 2048, twice=True
    ),
    "glb": Format(gltf_files.originals, gltf_files.changed, read_scene, 64 * MIB, 2048, twice=True),
    "gltf": Format(gltf_files.gltf_originals, gltf_files.changed_gltf, read_scene, 64 * MIB, 2048, twice=True),
    "splat": _single(
        "a.splat", splat_files.splat_originals, splat_files.changed_splat, read_scene, 32 * MIB, 64, twice=True
    ),
    "ksplat": _single(
        "a.ksplat", splat_files.ksplat_originals, splat_files.changed_ksplat, read_scene, 32 * MIB, 64, twice=True
    ),
    "ply.gz": _single("a.ply.gz", gzip_files.originals, gzip_files.changed, read_scene, 64 * MIB, 4096, twice=True),
    "cameras.json": Format(
        camera_files.good_cameras_json, camera_files.changed_cameras_json, read_cameras, 32 * MIB, 128
    ),
    "transforms.json": Format(
        camera_files.good_transforms_json, camera_files.changed_transforms_json, read_cameras, 32 * MIB, 128
    ),
    "colmap-binary": Format(
        camera_files.good_colmap_binary, camera_files.changed_colmap_binary, read_cameras, 32 * MIB, 128
    ),
    "colmap-text": Format(
        camera_files.good_colmap_text, camera_files.changed_colmap_text, read_cameras, 32 * MIB, 128
    ),
    "png": _picture("a.png", picture_files.good_pngs, picture_files.changed_png),
    "jpeg": _picture("a.jpg", picture_files.jpeg_originals, picture_files.changed_jpeg),
    "webp": _picture("a.webp", picture_files.webp_originals, picture_files.changed_webp),
}  # fmt: skip
