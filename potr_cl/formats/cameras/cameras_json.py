"""Views from cameras.json, which the original 3DGS implementation writes beside a trained scene.

A list of objects: ``img_name``, ``width``, ``height``, ``fx``, ``fy`` in pixels (principal point at the image's
centre), ``rotation`` (3 x 3, its columns are the camera's axes in the world, x right, y down, z forward) and
``position`` (the camera centre in the world).

The original lists its test views too, without a mark, so they cannot be told apart: without a mark every view counts
as a training view. A key ``split`` ("train" or "test") marks one; once a view has it, all must.
"""

from __future__ import annotations

import collections
import logging
from pathlib import Path
from typing import Any

from potr_cl.errors import DataError
from potr_cl.formats.cameras.view_files import (
    IMAGE_SUFFIXES,
    camera_of,
    excerpt,
    image_name,
    image_side,
    matrix,
    number,
    points_beside,
    read_json,
    stem,
    view_names,
)
from potr_cl.formats.declaration import CameraFormat
from potr_cl.model.camera import Camera

_log = logging.getLogger("potr_cl")


def load(path: Path) -> list[Camera]:
    """The views of a cameras.json, in file order; see ``load`` of :class:`potr_cl.formats.declaration.CameraFormat`.

    Ground truth is looked for in the folder ``images`` beside it.
    """
    return parse(read_json(path), path)


def parse(content: Any, path: Path) -> list[Camera]:
    """The views of a cameras.json whose JSON has been read already; see :func:`load`."""
    if not isinstance(content, list) or not all(isinstance(view, dict) for view in content):
        raise DataError(f"'{path}' is no cameras.json: it is not a list of views")
    if not content:
        raise DataError(f"'{path}' has no views")
    files = [image_name(view.get("img_name"), f"'{path}', view {i}: 'img_name'") for i, view in enumerate(content)]
    ground_truth = {stem(image.name): image for image in _images_beside(path)}
    points = points_beside(path.parent, "input.ply")
    marked = any("split" in view for view in content)
    return [
        _camera(view, name, path, ground_truth.get(Path(stem(file)).name), points, marked)
        for view, name, file in zip(content, _names(files, path), files, strict=True)
    ]


FORMAT = CameraFormat(
    name="cameras.json",
    suffixes=(".json",),
    note="of the original implementation; a `split` entry a view, `train` or `test`, is honoured",
    recognises=lambda path, content: isinstance(content, list),
    load=lambda path, content: parse(content, path),
    is_in=lambda folder: (folder / "cameras.json").exists(),
    load_folder=lambda folder: load(folder / "cameras.json"),
    json_mark="a list",
)


def _camera(
    view: dict[str, Any], name: str, path: Path, ground_truth: Path | None, points: Path | None, marked: bool
) -> Camera:
    where = f"'{path}', view '{name}'"
    for key in ("width", "height", "fx", "fy", "rotation", "position", *(["split"] if marked else [])):
        if key not in view:
            raise DataError(f"{where}: '{key}' is missing")
    split = view.get("split", "train")
    if split not in ("train", "test"):
        raise DataError(f"{where}: 'split' is {excerpt(split)}, neither 'train' nor 'test'")
    width = image_side(view["width"], f"{where}: 'width'")
    height = image_side(view["height"], f"{where}: 'height'")
    rotation = matrix(view["rotation"], [(3, 3)], f"{where}: 'rotation'").T
    return camera_of(
        path,
        name=name,
        width=width,
        height=height,
        fx=number(view["fx"], f"{where}: 'fx'"),
        fy=number(view["fy"], f"{where}: 'fy'"),
        cx=width / 2,
        cy=height / 2,
        rotation=rotation,
        translation=-rotation @ matrix(view["position"], [(3,)], f"{where}: 'position'"),
        split=split,
        image_path=ground_truth,
        points_path=points,
    )


def _names(files: list[str], path: Path) -> list[str]:
    """Names of the views; the original names a train and a test image of a synthetic scene both ``r_0``."""
    if len(set(files)) == len(files):
        return view_names(files, path)
    seen: collections.Counter[str] = collections.Counter()
    names = []
    for file in files:
        seen[file] += 1
        names.append(stem(file) if seen[file] == 1 else f"{stem(file)}_{seen[file]}")
    _log.warning("'%s': several views have the same name; the later ones get a number appended", path)
    return view_names(names, path)


def _images_beside(path: Path) -> list[Path]:
    folder = path.parent / "images"
    return [image for image in folder.iterdir() if image.suffix.lower() in IMAGE_SUFFIXES] if folder.is_dir() else []
