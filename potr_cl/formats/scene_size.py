"""How large a scene is on disk (:func:`bytes_of_scene`), also where it is in several files."""

from __future__ import annotations

import os
from pathlib import Path

from potr_cl.errors import PotrError, UsageError
from potr_cl.formats import registry
from potr_cl.formats.levels import without_level


def bytes_of_scene(path: str | os.PathLike[str]) -> int | None:
    """Bytes of a scene: of its file, or of all files that belong to it, whatever level of detail is read.

    Args:
        path: as :func:`potr_cl.formats.load_scene` takes it.

    Returns:
        The number, of the files that there are; None where there is no such scene, or no reader would know its files.
    """
    given = without_level(path)
    try:
        if not given.exists():
            return None
        return sum(file.stat().st_size for file in _files(given) if file.is_file()) or None
    except (OSError, ValueError, PotrError):
        return None


def _files(path: Path) -> list[Path]:
    try:
        files = registry.format_of(path).files
    except UsageError:  # of a .potr file by another name, its own
        files = None
    return [path] if files is None else files(path)
