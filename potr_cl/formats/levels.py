"""Which level of detail of a scene is read: a number behind the path, "scene/lod-meta.json#1"."""

from __future__ import annotations

import os
import re
from pathlib import Path

#: A path's last part, and the level behind it.
_NAMED = re.compile(r"(.+)#(\d{1,6})", re.DOTALL)


def path_and_level(path: str | os.PathLike[str]) -> tuple[Path, int | None]:
    """A path without its level, and the level, None where it names none: also where such a file exists."""
    given = Path(path)
    named = _NAMED.fullmatch(given.name)
    if named is None or os.path.lexists(given):
        return given, None
    return given.with_name(named[1]), int(named[2])


def without_level(path: str | os.PathLike[str]) -> Path:
    """A path without the level behind it."""
    return path_and_level(path)[0]
