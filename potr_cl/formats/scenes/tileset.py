"""Scenes as 3D Tiles 1.1 (tileset.json): the finest tiles of glTF with splats, in the axes of those.

Tiles are read whose content replaces that of the tile above, as tools write levels of detail; what places the whole on
Earth is left out. Specification: github.com/CesiumGS/3d-tiles.
"""

from __future__ import annotations

import json
import logging
import os
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import gltf
from potr_cl.formats.scenes.scene_files import check_splats, cleaned, file_in_folder, joined, opened, related, shown
from potr_cl.model.scene import Scene

_log = logging.getLogger("potr_cl")

DESCRIPTION = "tileset.json"


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """Read the finest tiles; see :class:`potr_cl.formats.declaration.SceneLoader`."""
    names = list(dict.fromkeys(_contents(file_in_folder(path, DESCRIPTION) or Path(path), finest=True)))
    scenes: list[Scene] = []
    nbytes = 0
    for name in names:  # each by itself may hold some splats for nothing
        scenes.append(gltf.load(name, trust))
        nbytes += sum(file.stat().st_size for file in gltf.files(name))
        check_splats(path, sum(map(len, scenes)), nbytes, trust)
    return cleaned(path, joined(scenes))


def files(path: Path) -> list[Path]:
    """The description, and the tiles that are there.

    Raises:
        UsageError: the description cannot be opened.
        DataError: it is damaged.
    """
    description = file_in_folder(path, DESCRIPTION) or path
    return [description, *(name for name in dict.fromkeys(_contents(description)) if name.is_file())]


FORMAT = SceneFormat(
    name="3D Tiles",
    suffixes=(),
    names=(DESCRIPTION,),
    files=files,
    note="of Cesium; a folder of levels of detail, tiles of glTF with splats: the finest are read",
    load=load,
    not_written="levels of detail are made by the command encode: -o FOLDER/tileset.json",
    packed=True,
)


def _contents(path: Path, finest: bool = False) -> Iterator[Path]:
    """The files of the tiles, of all or of the finest."""
    with opened(path) as (file, _):
        description = json.load(file)
    if not isinstance(description, dict) or not isinstance(description.get("root"), dict):
        raise DataError(f"'{path}' is no 3D Tiles tileset: it has no root")
    found = False
    tiles = [(description["root"], "ADD")]
    while tiles:
        tile, above = tiles.pop()
        if not isinstance(tile, dict):
            raise _damaged(path, "a tile is invalid")
        refine, children = tile.get("refine", above), tile.get("children", [])
        contents = [tile["content"]] if "content" in tile else tile.get("contents", [])
        if not isinstance(children, list) or not isinstance(contents, list):
            raise _damaged(path, "a tile is invalid")
        transform = tile.get("transform")
        if transform is not None and tile is description["root"]:
            _log.info("'%s': what places it on Earth is left out", path)
        elif transform is not None and transform != np.eye(4).ravel().tolist():
            raise DataError(f"'{path}': tiles with a place of their own cannot be read")
        if not (finest and children and refine == "REPLACE"):
            for content in contents:
                uri = content.get("uri") if isinstance(content, dict) else None
                name = related(path, urllib.parse.unquote(uri) if isinstance(uri, str) else uri)
                if name.suffix.lower() not in gltf.FORMAT.suffixes:
                    raise DataError(f"'{path}': tiles of {shown(name.name)} cannot be read, only those of glTF")
                found = True
                yield name
        tiles += [(child, refine) for child in reversed(children)]
    if not found:
        raise DataError(f"'{path}' has no tiles with content")


def _damaged(path: Path, what: str) -> DataError:
    return DataError(f"'{path}' is damaged: {what}")
