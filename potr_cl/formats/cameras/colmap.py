"""Views from a COLMAP sparse model: ``cameras`` and ``images``, as .bin or .txt files.

The model is read by pycolmap, which is an extra. It trusts its input: at the end of a truncated file it goes on with
what happens to be in memory, without an error, or takes memory until none is left. So it is handed copies whose
structure has been checked here, and without the points: those make up nearly all of a model, and no view needs them.
"""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.cameras.view_files import (
    camera_of,
    every_eighth,
    excerpt,
    image_name,
    image_side,
    read_bytes,
    view_names,
)
from potr_cl.formats.declaration import CameraFormat, install_command
from potr_cl.host.leftovers import temporary_folder
from potr_cl.model.camera import Camera

#: Of this package, which brings pycolmap.
EXTRA = "colmap"

#: COLMAP's pinhole models: their number in binary files and how many parameters they have.
_PINHOLES = {"SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4)}

_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters as float64
_IMAGE = struct.Struct("<I7dI")  # id, rotation, translation, camera; then the name, a zero, the 2-D points
_COUNT = struct.Struct("<Q")
_POINT_BYTES = 24


def is_model(folder: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return any((folder / f"cameras{ending}").exists() for ending in (".bin", ".txt"))


def load(folder: Path) -> list[Camera]:
    """Read the views of a sparse model.

    Each 8th image by name is a test view, as in the field's benchmarks. Ground truth is looked for in a folder
    ``images`` beside the model or up to two folders above it.

    Args:
        folder: holds cameras.bin and images.bin, or the same as .txt.

    Returns:
        The views, ordered by the names of their images.

    Raises:
        UsageError: pycolmap is not installed, or a file cannot be opened.
        DataError: the model is damaged, or a camera is not a pinhole.
    """
    ending = ".bin" if (folder / "cameras.bin").exists() else ".txt"
    cameras, images = _read_checked(folder, ending)
    path = folder / f"images{ending}"
    if not images:
        raise DataError(f"'{path}' holds no view")
    files = [image_name(image.name, f"'{path}': the name of image {image.image_id}") for image in images]
    ground_truth = _ground_truth(folder)
    return [
        _camera(path, image, cameras[image.camera_id], name, split, ground_truth / file if ground_truth else None)
        for image, name, file, split in zip(images, view_names(files, path), files, every_eighth(files), strict=True)
    ]


FORMAT = CameraFormat(
    name="COLMAP model (cameras and images as .bin or .txt)",
    suffixes=(".bin", ".txt"),
    note="binary or text, also in the folder `sparse/0` or `sparse`; every 8th view by name is a test view",
    recognises=lambda path, content: is_model(path.parent),
    load=lambda path, content: load(path.parent),
    is_in=is_model,
    load_folder=load,
    subfolders=("sparse/0", "sparse"),
    extra=EXTRA,
)


def _camera(path: Path, image: Any, lens: Any, name: str, split: str, ground_truth: Path | None) -> Camera:
    pose = image.cam_from_world()
    if not abs(math.hypot(*pose.rotation.quat) - 1) < 1e-3:  # zero would silently mean no rotation
        raise DataError(f"'{path}', view '{name}': its rotation is not a unit quaternion")
    world_to_camera = np.asarray(pose.matrix(), dtype=np.float64)
    return camera_of(
        path,
        name=name,
        width=image_side(lens.width, f"'{path}', view '{name}': the width of its camera"),
        height=image_side(lens.height, f"'{path}', view '{name}': the height of its camera"),
        fx=float(lens.params[0]),
        fy=float(lens.params[-3]),  # the only focal length of a SIMPLE_PINHOLE
        cx=float(lens.params[-2]),
        cy=float(lens.params[-1]),
        rotation=world_to_camera[:, :3],
        translation=world_to_camera[:, 3],
        split=split,
        image_path=ground_truth if ground_truth and os.path.isfile(ground_truth) else None,
    )


def _read_checked(folder: Path, ending: str) -> tuple[Any, list[Any]]:
    """The cameras of a model by number, and its images by name, as pycolmap's objects."""
    pycolmap = _pycolmap()
    cameras, images = folder / f"cameras{ending}", folder / f"images{ending}"
    if ending == ".bin":
        content = {
            cameras.name: _check_binary_cameras(read_bytes(cameras), cameras),
            images.name: _without_points_binary(read_bytes(images), images),
            "points3D.bin": _COUNT.pack(0),
        }
    else:
        content = {
            cameras.name: _check_text_cameras(read_bytes(cameras), cameras),
            images.name: _without_points_text(read_bytes(images), images),
            "points3D.txt": b"",
        }
    with temporary_folder() as copy:
        for name, data in content.items():
            Path(copy, name).write_bytes(data)
        try:
            model = pycolmap.Reconstruction(copy)
            return model.cameras, sorted(model.images.values(), key=lambda image: image.name)
        except UnicodeDecodeError as error:
            raise DataError(f"'{images}': the name of an image is not UTF-8: rename it") from error
        except Exception as error:  # the library raises what its parts happen to raise
            reason = " ".join(str(error).split())[:200]
            raise DataError(f"'{folder}' is a damaged COLMAP model: {reason}") from error


def _pycolmap() -> ModuleType:
    try:
        import pycolmap
    except ImportError as error:
        raise UsageError(f"reading COLMAP models needs pycolmap: {install_command(EXTRA)}") from error
    return pycolmap  # type: ignore[no-any-return]


def _ground_truth(folder: Path) -> Path | None:
    """The folder that the names of the images are relative to, if it is where it usually is."""
    absolute = Path(os.path.abspath(folder))
    candidates = (parent / "images" for parent in (absolute, *absolute.parents[:2]))
    return next((candidate for candidate in candidates if candidate.is_dir()), None)


def _distorted(path: Path, camera: str, model: str) -> DataError:
    return DataError(
        f"'{path}': camera {camera} has the model {excerpt(model)}, only {' and '.join(_PINHOLES)} are supported: "
        "undistort the images with 'colmap image_undistorter' and use the model that it writes"
    )


def _model_name(number: int) -> str:
    name = str(_pycolmap().CameraModelId(number).name)
    return f"number {number}" if name == "???" else name


def _truncated(path: Path) -> DataError:
    return DataError(f"'{path}' is truncated, or is no file of a COLMAP model")


def _check_binary_cameras(data: bytes, path: Path) -> bytes:
    parameters = dict(_PINHOLES.values())
    try:
        (count,) = _COUNT.unpack_from(data)
        offset = _COUNT.size
        for _ in range(count):
            identifier, model, _, _ = _CAMERA.unpack_from(data, offset)
            if model not in parameters:
                raise _distorted(path, str(identifier), _model_name(model))
            offset += _CAMERA.size + 8 * parameters[model]
    except struct.error as error:
        raise _truncated(path) from error
    if offset != len(data):
        raise _truncated(path)
    return data


def _without_points_binary(data: bytes, path: Path) -> bytes:
    kept = [data[: _COUNT.size]]
    try:
        (count,) = _COUNT.unpack_from(data)
        offset = _COUNT.size
        for _ in range(count):
            name_end = data.index(b"\0", offset + _IMAGE.size)
            (points,) = _COUNT.unpack_from(data, name_end + 1)
            kept += [data[offset : name_end + 1], _COUNT.pack(0)]
            offset = name_end + 1 + _COUNT.size + points * _POINT_BYTES
    except (struct.error, ValueError) as error:
        raise _truncated(path) from error
    if offset != len(data):
        raise _truncated(path)
    return b"".join(kept)


def _check_text_cameras(data: bytes, path: Path) -> bytes:
    for line in data.splitlines():
        fields = line.decode("utf-8", "replace").split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) < 4:
            raise _truncated(path)
        if fields[1] not in _PINHOLES:
            raise _distorted(path, excerpt(fields[0]), fields[1])
        if len(fields) != 4 + _PINHOLES[fields[1]][1]:
            raise _truncated(path)
    return data


def _without_points_text(data: bytes, path: Path) -> bytes:
    """Each image has two lines, the second one, its 2-D points, may be empty."""
    kept = []
    lines = iter(data.splitlines())
    for line in lines:
        fields = line.split(maxsplit=9)
        if not fields or fields[0].startswith(b"#"):
            continue
        if len(fields) < 10:
            raise _truncated(path)
        kept.append(line + b"\n\n")
        next(lines, None)
    return b"".join(kept)
