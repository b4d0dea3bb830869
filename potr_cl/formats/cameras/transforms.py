"""Views from transforms.json files: those of Blender scenes (NeRF-Synthetic) and those of nerfstudio.

Both are an object with a list ``frames``, each with ``file_path`` and ``transform_matrix`` (camera to world, OpenGL
axes: x right, y up, z backward). Intrinsics stand in the frame or, for all frames, beside ``frames``: ``fl_x``,
``fl_y``, ``cx``, ``cy``, ``w``, ``h`` in pixels, or ``camera_angle_x`` in radians. What is missing is taken from the
image: its size, its centre, square pixels.

Splits: ``transforms_train.json`` and ``transforms_test.json`` are what their names say. A ``transforms.json`` may list
``train_filenames``, ``val_filenames`` and ``test_filenames``; if it does not, each 8th image is a test view.

Nerfstudio trains in a space of its own: if the ``dataparser_transforms.json`` of the training lies beside the file, the
views are moved there.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.cameras.view_files import (
    IMAGE_SUFFIXES,
    FoundView,
    cameras_of,
    every_eighth,
    excerpt,
    image_name,
    image_side,
    lens_coefficients,
    matrix,
    number,
    read_json,
    view_names,
)
from potr_cl.formats.declaration import CameraFormat
from potr_cl.model.camera import Camera

_log = logging.getLogger("potr_cl")

#: Models of nerfstudio and COLMAP, all of them Brown's, of which some coefficients may be missing; and the fisheyes.
_BROWN = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
#: As nerfstudio has them: k3 and k4 are further radial terms of both kinds.
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
#: A key by which a file of nerfstudio's ns-process-data is known: how it has turned COLMAP's world.
_PROCESSED = "applied_transform"
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class _Frame:
    """An entry of ``frames`` together with what the file says for all of them."""

    path: Path
    index: int
    own: dict[str, Any]
    common: dict[str, Any]

    def where(self, key: str) -> str:
        return f"'{self.path}', frame {self.index}: '{key}'"

    def get(self, key: str) -> Any:
        return self.own.get(key, self.common.get(key))

    def number(self, key: str) -> float | None:
        value = self.get(key)
        return None if value is None else number(value, self.where(key))

    @property
    def file(self) -> str:
        return image_name(self.own.get("file_path"), self.where("file_path"))


def load(path: Path) -> list[Camera]:
    """The views of a file, in its order; see ``load`` of :class:`potr_cl.formats.declaration.CameraFormat`.

    If its name ends in ``_test`` or ``_val`` they are test views, if in ``_train`` training views, else see the
    module's text.
    """
    return parse([(read_json(path), path)])


def is_in(folder: Path) -> bool:
    """Whether a folder holds a transforms file under one of its usual names."""
    return any((folder / name).exists() for name in ("transforms_train.json", "transforms.json"))


def load_folder(folder: Path) -> list[Camera]:
    """Read a folder's ``transforms_train.json`` and, if there is one, ``transforms_test.json``; see :func:`load`.

    Without the former, read ``transforms.json``.
    """
    paths = [folder / "transforms_train.json", folder / "transforms_test.json"]
    if not paths[0].exists():
        return load(folder / "transforms.json")
    return parse([(read_json(path), path) for path in paths if path.exists()])


FORMAT = CameraFormat(
    name="transforms.json",
    suffixes=(".json",),
    note="of Blender (`transforms_train.json`, `transforms_test.json`) and of nerfstudio, with its "
    "`dataparser_transforms.json`, with or without lens distortion",
    recognises=lambda path, content: isinstance(content, dict) and "frames" in content,
    load=lambda path, content: parse([(content, path)]),
    is_in=is_in,
    load_folder=load_folder,
    json_mark="with 'frames'",
)


def parse(contents: list[tuple[Any, Path]]) -> list[Camera]:
    """The views of transforms files whose JSON has been read already; see :func:`load`."""
    frames: list[_Frame] = []
    splits: list[str] = []
    for content, path in contents:
        of_file = _frames(content, path)
        splits += _splits(of_file, content, path)
        frames += of_file
    names = view_names([frame.file for frame in frames], contents[0][1])
    placements = {path: _placement(content, path) for content, path in contents}
    views = [
        _view(frame, name, split, *placements[frame.path])
        for frame, name, split in zip(frames, names, splits, strict=True)
    ]
    return cameras_of(contents[0][1], views)


def _frames(content: Any, path: Path) -> list[_Frame]:
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list):
        raise DataError(f"'{path}' is no transforms.json: it is not an object with a list 'frames'")
    if not frames:
        raise DataError(f"'{path}' has no views")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(f"'{path}', frame {i} is {excerpt(frame)}, not an object")
    return [_Frame(path, i, frame, content) for i, frame in enumerate(frames)]


def _splits(frames: list[_Frame], content: dict[str, Any], path: Path) -> list[str]:
    files = [frame.file for frame in frames]
    if path.stem.endswith("_train"):
        return ["train"] * len(files)
    if path.stem.endswith(("_test", "_val")):
        return ["test"] * len(files)
    listed = {key: _listed(content, key, files, path) for key in ("train_filenames", "val_filenames", "test_filenames")}
    if "train_filenames" in content:
        return ["train" if file in listed["train_filenames"] else "test" for file in files]
    if "val_filenames" in content or "test_filenames" in content:
        return ["test" if file in listed["val_filenames"] | listed["test_filenames"] else "train" for file in files]
    return every_eighth(files)


def _listed(content: dict[str, Any], key: str, files: list[str], path: Path) -> set[str]:
    entries = content.get(key, [])
    if not isinstance(entries, list):
        raise DataError(f"'{path}': '{key}' is {excerpt(entries)}, not a list")
    listed = {image_name(entry, f"'{path}': an entry of '{key}'") for entry in entries}
    unknown = sorted(listed - set(files))
    if unknown:
        raise DataError(f"'{path}': '{key}' names {excerpt(unknown[0])}, which is the file_path of no frame")
    return listed


def _view(frame: _Frame, name: str, split: str, placement: NDArray[np.float64], scale: float) -> FoundView:
    distortion = _distortion(frame)
    image = _image_path(frame)
    width, height = _image_size(frame, image)
    fx = _focal_length(frame, "x", width)
    fy = _focal_length(frame, "y", height)
    if fx is None:
        raise DataError(f"'{frame.path}', frame {frame.index}: neither 'fl_x' nor 'camera_angle_x' is given")
    cx, cy = frame.number("cx"), frame.number("cy")
    to_world = matrix(frame.own.get("transform_matrix"), [(4, 4), (3, 4)], frame.where("transform_matrix"))
    if to_world.shape == (4, 4) and not np.allclose(to_world[3], (0, 0, 0, 1)):
        raise DataError(f"{frame.where('transform_matrix')}: its last row is not 0 0 0 1")
    to_world = placement @ np.vstack([to_world[:3], (0, 0, 0, 1)])
    rotation = (to_world[:3, :3] @ _OPENGL_TO_OPENCV).T
    fields: dict[str, Any] = {
        "width": width,
        "height": height,
        "fx": fx,
        "fy": fx if fy is None else fy,
        "cx": width / 2 if cx is None else cx,
        "cy": height / 2 if cy is None else cy,
    }
    rest = {
        "name": name,
        "rotation": rotation,
        "translation": -rotation @ (scale * to_world[:3, 3]),
        "split": split,
        "image_path": image if os.path.isfile(image) else None,
    }
    return FoundView(frame.path, f"frame {frame.index}", fields, distortion, rest)


def _distortion(frame: _Frame) -> dict[str, Any] | None:
    """The coefficients of the frame's lens, as :func:`lens_coefficients` gives them."""
    mend = "leave these views out, or cut them into pinhole views, as nerfstudio's ns-process-data does"
    model = frame.get("camera_model")
    if model is not None and model not in (*_BROWN, *_FISHEYES):
        raise DataError(
            f"{frame.where('camera_model')} is {excerpt(model)}, whose pictures no pinhole view can stand for: {mend}"
        )
    values = {key: frame.number(key) or 0.0 for key in _DISTORTION}
    return lens_coefficients(values, fisheye=model in _FISHEYES or frame.get("is_fisheye") is True)


def _image_path(frame: _Frame) -> Path:
    path = frame.path.parent / frame.file
    return path if path.suffix.lower() in IMAGE_SUFFIXES else Path(f"{path}.png")


def _image_size(frame: _Frame, image: Path) -> tuple[int, int]:
    width, height = frame.get("w"), frame.get("h")
    if width is not None and height is not None:
        return image_side(width, frame.where("w")), image_side(height, frame.where("h"))
    from potr_cl.formats.images import image_size  # imported on use: most files name the size

    try:
        width, height = image_size(image)  # reads no pixels
    except UsageError as error:
        raise DataError(
            f"'{frame.path}', frame {frame.index}: the size of the view is unknown: "
            f"the file has no 'w' and 'h', and the image '{image}' cannot be opened: give one of them"
        ) from error
    except DataError as error:
        raise DataError(
            f"'{frame.path}', frame {frame.index}: the size of the view is unknown: the file has no 'w' and 'h', and "
            f"{error}"
        ) from error
    return image_side(width, f"'{image}': the width"), image_side(height, f"'{image}': the height")


def _focal_length(frame: _Frame, axis: str, side: int) -> float | None:
    focal = frame.number(f"fl_{axis}")
    angle = frame.number(f"camera_angle_{axis}")
    if focal is not None or angle is None:
        return focal
    if not 0 < angle < math.pi:
        raise DataError(f"{frame.where(f'camera_angle_{axis}')} is {angle}, not an angle between 0 and π")
    return side / 2 / math.tan(angle / 2)


def _placement(content: dict[str, Any], path: Path) -> tuple[NDArray[np.float64], float]:
    """How nerfstudio moved the views of this file before training: a rigid (4, 4) matrix, then a scale.

    The file beside it holds the whole way from the reconstruction to the training space; the first part of that
    way, ``applied_transform`` and ``applied_scale``, is in the views already.
    """
    beside = path.with_name("dataparser_transforms.json")
    if not beside.exists():
        if _PROCESSED in content:
            _log.warning(
                "'%s': the views are taken as they stand; if nerfstudio trained the scene, put the %s of the "
                "training's output folder beside the file, since nerfstudio moves and scales views before it trains",
                path,
                beside.name,
            )
        return np.eye(4), 1.0
    whole = read_json(beside)
    if not isinstance(whole, dict):
        raise DataError(f"'{beside}' is no dataparser_transforms.json: it is not an object")
    placement = _rigid(whole.get("transform"), f"'{beside}': 'transform'")
    if _PROCESSED in content:
        placement = placement @ np.linalg.inv(_rigid(content[_PROCESSED], f"'{path}': '{_PROCESSED}'"))
    scale = _positive(whole.get("scale"), f"'{beside}': 'scale'")
    scale /= _positive(content.get("applied_scale", 1), f"'{path}': 'applied_scale'")
    _log.warning("'%s': moved the views to the training space that '%s' describes", path, beside.name)
    return placement, scale


def _rigid(value: Any, where: str) -> NDArray[np.float64]:
    array = np.vstack([matrix(value, [(3, 4), (4, 4)], where)[:3], (0, 0, 0, 1)])
    if np.abs(array[:3, :3] @ array[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise DataError(f"{where} is not a rotation and a translation")
    return array


def _positive(value: Any, where: str) -> float:
    scale = number(value, where)
    if scale <= 0:
        raise DataError(f"{where} is {scale}, not above 0")
    return scale
