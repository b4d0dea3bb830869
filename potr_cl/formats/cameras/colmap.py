"""Views from a COLMAP sparse model: ``cameras`` and ``images``, as .bin or .txt files.

They are read here, without COLMAP's own library: it trusts its input, and it reads whole models from a folder only,
with the points, which make up nearly all of a model and which no view needs.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.cameras.view_files import (
    FoundView,
    cameras_of,
    every_eighth,
    excerpt,
    image_name,
    image_side,
    lens_coefficients,
    points_beside,
    read_bytes,
    view_names,
)
from potr_cl.formats.declaration import CameraFormat
from potr_cl.model.camera import Camera

#: COLMAP's camera models, by their number in binary files.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
)
#: Those that are read, and the names of their parameters in order: one focal length or two, the principal point, and
#: what :class:`potr_cl.model.lens.Lens` calls the rest.
_READ = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 q1 q2 q3",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2",
}

_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters as float64
_IMAGE = struct.Struct("<I7dI")  # id, rotation, translation, camera; then the name, a zero, the 2-D points
_COUNT = struct.Struct("<Q")
_POINT_BYTES = 24
_LARGEST_ID = 2**32 - 1


@dataclass(frozen=True)
class _Lens:
    """A camera as COLMAP means it: what images have in common. ``params``: in the order that the model has them."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def view(self, path: Path, name: str, rest: dict[str, Any]) -> FoundView:
        """A view of it, which is in that file under that name."""
        where = f"'{path}', {name}"
        named = dict(zip(_READ[self.model].split(), self.params, strict=True))
        fx = named.get("fx", named.get("f"))
        size = {
            "width": image_side(self.width, f"{where}: the width of its camera"),
            "height": image_side(self.height, f"{where}: the height of its camera"),
        }
        frame = {**size, "fx": fx, "fy": named.get("fy", fx), "cx": named["cx"], "cy": named["cy"]}
        return FoundView(path, name, frame, lens_coefficients(named, fisheye="FISHEYE" in self.model), rest)


@dataclass(frozen=True)
class _Image:
    """A view: its pose from the world as a quaternion w, x, y, z and a translation, its lens by number, its file."""

    number: int
    rotation: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


def is_model(folder: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return any((folder / f"cameras{ending}").exists() for ending in (".bin", ".txt"))


def load(folder: Path) -> list[Camera]:
    """The views of a sparse model, cameras and images as .bin or .txt, ordered by the names of their images.

    Each 8th image by name is a test view, as in the field's benchmarks. Ground truth is looked for in a folder
    ``images`` beside the model or up to two folders above it. What is raised says
    :class:`potr_cl.formats.declaration.CameraFormat`.
    """
    ending = ".bin" if (folder / "cameras.bin").exists() else ".txt"
    lenses, images = _lenses(folder / f"cameras{ending}"), _images(folder / f"images{ending}")
    path = folder / f"images{ending}"
    if not images:
        raise DataError(f"'{path}' has no views")
    for image in images:
        if image.lens not in lenses:
            raise DataError(f"'{folder}' is a damaged COLMAP model: image {image.number} has an unknown camera")
    files = [image_name(image.name, f"'{path}': the name of image {image.number}") for image in images]
    ground_truth, points = _ground_truth(folder), points_beside(folder, "points3D.bin", "points3D.txt")
    views = [
        _view(path, image, lenses[image.lens], name, split, ground_truth / file if ground_truth else None, points)
        for image, name, file, split in zip(images, view_names(files, path), files, every_eighth(files), strict=True)
    ]
    return cameras_of(folder, views)


FORMAT = CameraFormat(
    name="COLMAP model (cameras and images as .bin or .txt)",
    suffixes=(".bin", ".txt"),
    note="binary or text, with or without lens distortion, also in the folder `sparse/0`, `sparse` or `0`; every 8th "
    "view by name is a test view",
    recognises=lambda path, content: is_model(path.parent),
    load=lambda path, content: load(path.parent),
    is_in=is_model,
    load_folder=load,
    subfolders=("sparse/0", "sparse", "0"),
)


def _view(
    path: Path, image: _Image, lens: _Lens, name: str, split: str, ground_truth: Path | None, points: Path | None
) -> FoundView:
    if not abs(math.hypot(*image.rotation) - 1) < 1e-3:
        raise DataError(f"'{path}', view '{name}': its rotation is not a unit quaternion")
    rest = {
        "name": name,
        "rotation": _matrix(*image.rotation),
        "translation": np.array(image.translation),
        "split": split,
        "image_path": ground_truth if ground_truth and os.path.isfile(ground_truth) else None,
        "points_path": points,
    }
    return lens.view(path, f"view '{name}'", rest)


def _matrix(w: float, x: float, y: float, z: float) -> NDArray[np.float64]:
    """(3, 3) rotation of a quaternion, by the formula that COLMAP uses, for the same digits."""
    return np.array(
        [
            [1 - (2 * y * y + 2 * z * z), 2 * y * x - 2 * z * w, 2 * z * x + 2 * y * w],
            [2 * y * x + 2 * z * w, 1 - (2 * x * x + 2 * z * z), 2 * z * y - 2 * x * w],
            [2 * z * x - 2 * y * w, 2 * z * y + 2 * x * w, 1 - (2 * x * x + 2 * y * y)],
        ]
    )


def _ground_truth(folder: Path) -> Path | None:
    """The folder that the names of the images are relative to, if it is where it usually is."""
    absolute = Path(os.path.abspath(folder))
    candidates = (parent / "images" for parent in (absolute, *absolute.parents[:2]))
    return next((candidate for candidate in candidates if candidate.is_dir()), None)


def _lenses(path: Path) -> dict[int, _Lens]:
    """The cameras of a model by number."""
    lenses: dict[int, _Lens] = {}
    read = _binary_lenses if path.suffix == ".bin" else _text_lenses
    for number, lens in read(read_bytes(path), path):
        if number in lenses:
            raise _damaged(path, f"camera {number} stands twice")
        lenses[number] = lens
    return lenses


def _images(path: Path) -> list[_Image]:
    """The images of a model by name."""
    read = _binary_images if path.suffix == ".bin" else _text_images
    images = list(read(read_bytes(path), path))
    if len({image.number for image in images}) < len(images):
        raise _damaged(path, "two images have the same number")
    return sorted(images, key=lambda image: image.name)


def _unread(path: Path, camera: str, model: str) -> DataError:
    return DataError(
        f"'{path}': camera {camera} has the model {excerpt(model)}, which is not supported: undistort the images with "
        "'colmap image_undistorter' and use the model that it writes"
    )


def _truncated(path: Path) -> DataError:
    return DataError(f"'{path}' is truncated, or is no file of a COLMAP model")


def _damaged(path: Path, how: str) -> DataError:
    return DataError(f"'{path.parent}' is a damaged COLMAP model: {how} in '{path.name}'")


def _name(raw: bytes, path: Path) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"'{path}': the name of an image is not UTF-8: rename it") from error


def _binary_lenses(data: bytes, path: Path) -> Iterator[tuple[int, _Lens]]:
    try:
        (count,) = _COUNT.unpack_from(data)
        offset = _COUNT.size
        for _ in range(count):
            number, model, width, height = _CAMERA.unpack_from(data, offset)
            name = _MODELS[model] if 0 <= model < len(_MODELS) else f"number {model}"
            if name not in _READ:
                raise _unread(path, str(number), name)
            params = struct.unpack_from(f"<{len(_READ[name].split())}d", data, offset + _CAMERA.size)
            offset += _CAMERA.size + 8 * len(params)
            yield number, _Lens(name, width, height, params)
    except struct.error as error:
        raise _truncated(path) from error
    if offset != len(data):
        raise _truncated(path)


def _binary_images(data: bytes, path: Path) -> Iterator[_Image]:
    try:
        (count,) = _COUNT.unpack_from(data)
        offset = _COUNT.size
        for _ in range(count):
            number, *pose, lens = _IMAGE.unpack_from(data, offset)
            name_end = data.index(b"\0", offset + _IMAGE.size)
            (points,) = _COUNT.unpack_from(data, name_end + 1)
            name = data[offset + _IMAGE.size : name_end]
            offset = name_end + 1 + _COUNT.size + points * _POINT_BYTES
            if offset > len(data):
                raise _truncated(path)
            yield _Image(number, tuple(pose[:4]), tuple(pose[4:]), lens, _name(name, path))
    except (struct.error, ValueError) as error:
        raise _truncated(path) from error
    if offset != len(data):
        raise _truncated(path)


def _text_lenses(data: bytes, path: Path) -> Iterator[tuple[int, _Lens]]:
    for line in data.splitlines():
        fields = line.decode("utf-8", "replace").split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) < 4:
            raise _truncated(path)
        if fields[1] not in _READ:
            raise _unread(path, excerpt(fields[0]), fields[1])
        if len(fields) != 4 + len(_READ[fields[1]].split()):
            raise _truncated(path)
        params = tuple(_real(field, path) for field in fields[4:])
        yield _whole(fields[0], path), _Lens(fields[1], _whole(fields[2], path), _whole(fields[3], path), params)


def _text_images(data: bytes, path: Path) -> Iterator[_Image]:
    """Each image has two lines, the second one, its 2-D points, may be empty."""
    lines = iter(data.splitlines())
    for line in lines:
        fields = line.split(maxsplit=9)
        if not fields or fields[0].startswith(b"#"):
            continue
        if len(fields) < 10:
            raise _truncated(path)
        number, *pose, lens = (field.decode("utf-8", "replace") for field in fields[:9])
        values = [_real(field, path) for field in pose]
        name = _name(fields[9].rstrip(), path)
        yield _Image(_whole(number, path), tuple(values[:4]), tuple(values[4:]), _whole(lens, path), name)
        next(lines, None)


def _real(field: str, path: Path) -> float:
    # Python alone would also take "1_0" for a number.
    if not re.fullmatch(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(nan|inf)", field, re.ASCII | re.I):
        raise _damaged(path, f"{excerpt(field)} is not a number")
    return float(field)


def _whole(field: str, path: Path) -> int:
    if not re.fullmatch(r"[0-9]{1,10}", field, re.ASCII) or int(field) > _LARGEST_ID:
        raise _damaged(path, f"{excerpt(field)} is not a whole number of 32 bits")
    return int(field)
