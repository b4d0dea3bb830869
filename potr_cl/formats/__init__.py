"""One module a file format, each with load(path) and, where we write it, save(path, …)."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from potr_cl.codec.decoder import decode
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.cameras import cameras_json, colmap, transforms
from potr_cl.formats.cameras.view_files import read_json
from potr_cl.formats.scenes import compressed_ply, ply, sog, spz
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a trained scene; the extension tells the format.

    Args:
        path: of a .ply file, of a .potr file, which is decoded, or, with the extra ``convert``, of a compressed .ply,
            an .spz or a .sog file.

    Raises:
        UsageError: the file cannot be opened, its extension is unknown, or it needs an extra.
        DataError: its content is damaged.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return compressed_ply.load(path) if compressed_ply.is_compressed_ply(path) else ply.load(path)
    if suffix == ".potr":
        return decode(path)
    if suffix == ".spz":
        return spz.load(path)
    if suffix == ".sog":
        return sog.load(path)
    raise UsageError(f"'{path}': unknown kind of scene, expected a .ply, .potr, .spz or .sog file")


def scene_writer(path: Path) -> Callable[[Scene], None]:
    """What writes a scene to ``path`` in the format that its extension tells.

    Raises:
        UsageError: no format for whole scenes has this extension (a .potr file is what an encoder makes).
    """
    path = Path(path)
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-2:] == [".compressed", ".ply"]:
        return partial(compressed_ply.save, path)
    if suffixes[-1:] == [".ply"]:
        return partial(ply.save, path)
    if suffixes[-1:] == [".spz"]:
        return partial(spz.save, path)
    raise UsageError(f"'{path}': scenes are written as .ply, .compressed.ply or .spz")


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """Read the views of a scene; the content tells the format.

    Args:
        path: of a cameras.json, a transforms.json (Blender or nerfstudio), a file of a COLMAP model, or of a folder
            that holds such files or a COLMAP model in ``sparse/0`` or ``sparse``.

    Returns:
        The views with their split into training and test views; at least one.

    Raises:
        UsageError: there is nothing at ``path``, or it is of no known kind, or needs an extra.
        DataError: its content is damaged.
    """
    path = Path(path)
    try:
        return _from_folder(path) if path.is_dir() else _from_file(path)
    except OSError as error:
        raise UsageError(f"cannot read '{error.filename or path}': {error.strerror or error}") from error


def _from_file(path: Path) -> list[Camera]:
    kind = path.suffix.lower()
    if kind in (".bin", ".txt") and colmap.is_model(path.parent):
        return colmap.load(path.parent)
    if kind == ".json":
        content = read_json(path)
        if isinstance(content, list):
            return cameras_json.parse(content, path)
        if isinstance(content, dict) and "frames" in content:
            return transforms.parse([(content, path)])
        raise DataError(f"'{path}' is neither a cameras.json (a list) nor a transforms.json (with 'frames')")
    if not path.exists():
        raise UsageError(f"there is no file or folder '{path}'")
    raise UsageError(f"'{path}': unknown kind of cameras, {_EXPECTED}")


def _from_folder(folder: Path) -> list[Camera]:
    if colmap.is_model(folder):
        return colmap.load(folder)
    # cameras.json first: it lists just the views that a scene was trained with, as they were.
    if (folder / "cameras.json").exists():
        return cameras_json.load(folder / "cameras.json")
    if (folder / "transforms_train.json").exists():
        return transforms.load_folder(folder)
    if (folder / "transforms.json").exists():
        return transforms.load(folder / "transforms.json")
    for model in (folder / "sparse" / "0", folder / "sparse"):
        if colmap.is_model(model):
            return colmap.load(model)
    raise UsageError(f"the folder '{folder}' holds no cameras, {_EXPECTED}")


_EXPECTED = "expected a cameras.json, a transforms.json, or a COLMAP model (cameras and images as .bin or .txt)"
