"""Scenes as streamed SOG (PlayCanvas' lod-meta.json), version 1: one level of detail, or another, of a folder.

The description has a tree of boxes, whose leaves tell for each level which splats of which SOG folder are theirs. Level
0 is the finest. An environment, which viewers always show, belongs to every level.
"""

from __future__ import annotations

import json
import logging
import os
from collections import OrderedDict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
_MOST_LEVELS = 64
#: First splat and number of splats.
_Range = tuple[int, int]
#: A file's number, and the range.
_Part = tuple[int, int, int]
#: Bytes of unpacked files that :class:`StreamedScene` keeps.
_KEPT = 1 << 31


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
    meta = _described(description)
    ranges = meta.ranges(level or 0)
    names = {meta.files[number]: parts for number, parts in sorted(ranges.items())}
    if meta.environment is not None:
        names.setdefault(meta.environment, [])
    if not names:
        raise DataError(f"'{path}': level {level or 0} has no splats")
    scenes = [
        _part(where, _unpacked(where, sog), parts)
        for (where, sog), parts in zip(_sogs(path, list(names), trust), names.values(), strict=True)
    ]
    if meta.levels > 1 and level is None:
        _log.warning(
            "'%s' has %d levels of detail: the finest is read; '%s#1' is the next one", path, meta.levels, path
        )
    return cleaned(path, joined(scenes))


class StreamedScene:
    """All levels of a scene, of which only those files are read that are shown; they are kept for a while.

    Args:
        path: of the file lod-meta.json or the folder that it is in.
        trust: as of :func:`load`.

    Attributes:
        boxes: (leaves, 6) float64 x0, y0, z0, x1, y1, z1, world units.
        counts: (leaves, levels) int64 splats; 0 where a leaf lacks a level.
        errors: (leaves, levels) float64, what each level loses; None if the description has none.

    Raises:
        As :func:`load`.
    """

    def __init__(self, path: str | os.PathLike[str], trust: bool = False) -> None:
        description = file_in_folder(path, DESCRIPTION) or Path(path)
        self._path, self._trust, self._meta = path, trust, _described(description)
        leaves = list(self._meta.leaves())
        self._parts = [[part(level) for level in range(self._meta.levels)] for _, part in leaves]
        self.counts = np.array([[part[2] if part else 0 for part in own] for own in self._parts], np.int64)
        with reading(description):
            bounds = [node["bound"] for node, _ in leaves]
            sides = np.array([[*bound["min"], *bound["max"]] for bound in bounds], np.float64)
            self.boxes = sides.reshape(len(leaves), 6)
            told = [node.get("errors") for node, _ in leaves]
            self.errors = np.array(told, np.float64) if self._meta.has_errors else None
        if not np.isfinite(self.boxes).all() or (self.boxes[:, :3] > self.boxes[:, 3:]).any():
            raise DataError(f"'{path}' is damaged: a box is invalid")
        errors = self.errors
        if errors is not None and not (errors.shape == self.counts.shape and ((errors >= 0) & (errors < np.inf)).all()):
            raise DataError(f"'{path}' is damaged: errors of levels are invalid")
        self._kept: OrderedDict[Path, Scene] = OrderedDict()

    def shown(self, levels: NDArray[np.int64]) -> Scene:
        """What is drawn if each leaf shows a level of its own, (leaves,), or nothing (-1); and the environment.

        Raises:
            DataError: a file is damaged, or nothing is shown.
        """
        ranges: dict[Path, list[_Range]] = {}
        for own, level in zip(self._parts, levels.tolist(), strict=True):
            part = own[level] if level >= 0 else None
            if part is not None:
                ranges.setdefault(self._meta.files[part[0]], []).append(part[1:])
        if self._meta.environment is not None:
            ranges.setdefault(self._meta.environment, [])
        if not ranges:
            raise DataError(f"'{self._path}': what is to be shown has no splats")
        return joined([_part(where, self._file(where), parts) for where, parts in ranges.items()]).cleaned()[0]

    def _file(self, where: Path) -> Scene:
        if where not in self._kept:
            ((_, sog),) = _sogs(where, [where], self._trust)
            self._kept[where] = _unpacked(where, sog)
            while len(self._kept) > 1 and sum(scene.nbytes for scene in self._kept.values()) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(where)
        return self._kept[where]


def files(path: Path) -> list[Path]:
    """The description, and those of the levels that are there and of the environment, with the images that they name.

    Raises:
        UsageError: a description cannot be opened.
        DataError: a description is damaged.
    """
    description = file_in_folder(path, DESCRIPTION) or path
    meta = _described(description)
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
    not_written="levels of detail are made by the command encode: -o FOLDER/lod-meta.json",
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
        self._meta = meta
        self.levels = self._whole(meta.get("lodLevels"), 1, _MOST_LEVELS, "levels")
        names = meta.get("filenames")
        if not isinstance(names, list):
            raise self._damaged("it names no files")
        self.files = [related(path, name) for name in names]
        if len(set(self.files)) < len(self.files):
            raise self._damaged("it names a file twice")
        environment = meta.get("environment")
        self.environment = None if environment is None else related(path, environment)

    @property
    def has_errors(self) -> bool:
        return self._meta.get("lodErrors") is True

    def leaves(self) -> Iterator[tuple[dict[str, Any], Callable[[int], _Part | None]]]:
        """The leaves, and what gives the part that is a level's."""
        nodes = [self._meta["tree"]]
        while nodes:
            node = nodes.pop()
            if not isinstance(node, dict):
                raise self._damaged("its tree is invalid")
            levels, children = node.get("lods", {}), node.get("children", [])
            if not isinstance(levels, dict) or not isinstance(children, list):
                raise self._damaged("its tree is invalid")
            if levels:
                yield node, partial(self._part, levels)
            nodes += reversed(children)

    def ranges(self, level: int) -> dict[int, list[_Range]]:
        """Which splats of which files belong to a level. Raises UsageError if there is no such level."""
        if level >= self.levels:
            there = "only level 0" if self.levels == 1 else f"the levels 0 to {self.levels - 1}"
            raise UsageError(f"'{self._path}' has {there}, and no level {level}")
        found: dict[int, list[_Range]] = {}
        for _, part_of in self.leaves():
            part = part_of(level)
            if part is not None:
                found.setdefault(part[0], []).append(part[1:])
        return found

    def _part(self, levels: dict[str, Any], level: int) -> _Part | None:
        part = levels.get(str(level))
        if part is None:
            return None
        with reading(self._path):
            file = self._whole(part["file"], 0, len(self.files) - 1, "files")
            first, count = (self._whole(part[key], 0, 2**31, key) for key in ("offset", "count"))
        return file, first, count

    def _whole(self, value: Any, least: int, most: int, what: str) -> int:
        if type(value) is not int or not least <= value <= most:
            raise self._damaged(f"an impossible number of {what}: {shown(value)}")
        return value

    def _damaged(self, what: str) -> DataError:
        return DataError(f"'{self._path}' is damaged: {what}")


def _described(path: Path) -> _Meta:
    with opened(path) as (file, _):
        return _Meta(path, json.load(file))


def _sogs(path: str | os.PathLike[str], names: list[Path], trust: bool) -> list[tuple[Path, Sog]]:
    """SOG folders. All are described before one is unpacked: each by itself may hold some splats for nothing."""
    folders = [read_folder(file) for file in names]
    sogs = []
    for where, (text, images) in zip(names, folders, strict=True):
        with reading(where):
            sogs.append((where, Sog(where, text, images.__getitem__, folder_bytes(text, images), True)))
    check_splats(path, sum(sog.count for _, sog in sogs), sum(folder_bytes(*folder) for folder in folders), trust)
    return sogs


def _unpacked(path: Path, sog: Sog) -> Scene:
    with reading(path):
        return sog.scene()


def _part(path: Path, scene: Scene, ranges: list[_Range]) -> Scene:
    """Some splats of a SOG folder; all if there are no ranges."""
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
