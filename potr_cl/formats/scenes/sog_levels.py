"""Scenes as streamed SOG (PlayCanvas' lod-meta.json), version 1: one level of detail, or another, of a folder.

The description has a tree of boxes, whose leaves tell for each level which splats of which SOG folder are theirs. Level
0 is the finest. An environment, which viewers always show, belongs to every level.
"""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import sog
from potr_cl.formats.scenes.scene_files import (
    check_splats,
    cleaned,
    file_in_folder,
    joined,
    opened,
    path_and_level,
    reading,
    related,
    shown,
)
from potr_cl.formats.scenes.sog import Sog, folder_bytes, read_folder
from potr_cl.model.scene import Scene

_log = logging.getLogger("potr_cl")

DESCRIPTION = "lod-meta.json"
_MOST_LEVELS = 1000
#: First splat and number of splats.
_Range = tuple[int, int]


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """Read one level of a streamed SOG scene, with its environment.

    Args:
        path: of the file lod-meta.json or the folder that it is in, with "#" and the number of a level behind it; the
            finest, 0, if none is given.
        trust: as of :class:`potr_cl.formats.declaration.SceneLoader`, which tells what is raised; and:

    Raises:
        UsageError: there is no such level.
    """
    given, level = path_and_level(path)
    description = file_in_folder(given, DESCRIPTION) or given
    with opened(description) as (file, _):
        meta = _Meta(description, json.load(file))
        ranges = meta.ranges(level or 0)
    names = {meta.files[number]: parts for number, parts in sorted(ranges.items())}
    if meta.environment is not None:
        names.setdefault(meta.environment, [])
    if not names:
        raise DataError(f"'{path}': level {level or 0} has no splats")
    folders = [read_folder(file) for file in names]
    total = sum(folder_bytes(*folder) for folder in folders)
    # All are described before one is unpacked: each by itself may hold some splats for nothing.
    sogs = []
    for where, (text, images) in zip(names, folders, strict=True):
        with reading(where):
            sogs.append(Sog(where, text, images.__getitem__, folder_bytes(text, images), True))
    check_splats(path, sum(sog.count for sog in sogs), total, trust)
    scenes = [_part(file, sog, parts) for sog, (file, parts) in zip(sogs, names.items(), strict=True)]
    if meta.levels > 1 and level is None:
        _log.warning(
            "'%s' has %d levels of detail: the finest is read; '%s#1' is the next one", path, meta.levels, path
        )
    return cleaned(path, joined(scenes))


def files(path: Path) -> list[Path]:
    """The description, and those of the levels that are there and of the environment, with the images that they name.

    Raises:
        UsageError: a description cannot be opened.
        DataError: a description is damaged.
    """
    description = file_in_folder(path, DESCRIPTION) or path
    with opened(description) as (file, _):
        meta = _Meta(description, json.load(file))
    parts = meta.files if meta.environment is None else [*meta.files, meta.environment]
    return [description, *(file for part in dict.fromkeys(parts) if part.is_file() for file in sog.files(part))]


FORMAT = SceneFormat(
    name="streamed SOG",
    suffixes=(),
    names=(DESCRIPTION,),
    files=files,
    note="of PlayCanvas; a folder of levels of detail: the finest is read, with the environment, or the level N of "
    "`FOLDER/lod-meta.json#N`",
    load=load,
    not_written="nothing here writes streamed SOG: convert to .ply, and that with splat-transform",
    packed=True,
)


class _Meta:
    """The description, of which nothing is trusted.

    Attributes:
        levels: their number.
        files: the descriptions of the SOG folders, each once.
        environment: the description of the environment's folder; None if there is none.
    """

    def __init__(self, path: Path, meta: Any) -> None:
        self._path = path
        if not isinstance(meta, dict) or not isinstance(meta.get("tree"), dict):
            raise DataError(f"'{path}' is no description of a streamed SOG scene: it has no tree")
        if meta.get("version", 1) != 1:  # the first files had none
            raise DataError(f"'{path}' is a streamed SOG scene of version {shown(meta['version'])}, only 1 can be read")
        self._tree = meta["tree"]
        self.levels = self._whole(meta.get("lodLevels"), 1, _MOST_LEVELS, "levels")
        names = meta.get("filenames")
        if not isinstance(names, list):
            raise self._damaged("it names no files")
        self.files = [related(path, name) for name in names]
        if len(set(self.files)) < len(self.files):
            raise self._damaged("it names a file twice")
        environment = meta.get("environment")
        self.environment = None if environment is None else related(path, environment)

    def ranges(self, level: int) -> dict[int, list[_Range]]:
        """Which splats of which files belong to a level. Raises UsageError if there is no such level."""
        if level >= self.levels:
            there = "only level 0" if self.levels == 1 else f"the levels 0 to {self.levels - 1}"
            raise UsageError(f"'{self._path}' has {there}, and no level {level}")
        found: dict[int, list[_Range]] = {}
        nodes = [self._tree]
        while nodes:
            node = nodes.pop()
            if not isinstance(node, dict):
                raise self._damaged("its tree is invalid")
            levels, children = node.get("lods", {}), node.get("children", [])
            if not isinstance(levels, dict) or not isinstance(children, list):
                raise self._damaged("its tree is invalid")
            part = levels.get(str(level))
            if part is not None:
                number = self._whole(part["file"], 0, len(self.files) - 1, "files")
                first, count = (self._whole(part[key], 0, 2**31, key) for key in ("offset", "count"))
                found.setdefault(number, []).append((first, count))
            nodes += reversed(children)
        return found

    def _whole(self, value: Any, least: int, most: int, what: str) -> int:
        if type(value) is not int or not least <= value <= most:
            raise self._damaged(f"an impossible number of {what}: {shown(value)}")
        return value

    def _damaged(self, what: str) -> DataError:
        return DataError(f"'{self._path}' is damaged: {what}")


def _part(path: Path, sog: Sog, ranges: list[_Range]) -> Scene:
    """The splats of a SOG folder that a level has; all if there are no ranges."""
    with reading(path):
        scene = sog.scene()
    if not ranges:
        return scene
    ranges = sorted(ranges)
    end = 0
    for first, count in ranges:
        if first < end or first + count > len(scene):
            raise DataError(f"'{path}' has {len(scene)} splats: a level's parts overlap, or there are not so many")
        end = first + count
    index = np.concatenate([np.arange(first, first + count) for first, count in ranges])
    return scene if len(index) == len(scene) else scene.subset(index)
