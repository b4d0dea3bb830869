"""How large a scene is on disk (:func:`bytes_of_scene`), also where it is a folder of files."""

from __future__ import annotations

import os
from pathlib import Path

from potr_cl.errors import UsageError
from potr_cl.formats import registry
from potr_cl.formats.levels import without_level

#: What the folders of scenes consist of.
_PARTS = (".json", ".webp")


def bytes_of_scene(path: str | os.PathLike[str]) -> int | None:
    """Bytes of a scene's file; of a folder, those of all descriptions and images in it, whatever level is read.

    Args:
        path: as :func:`potr_cl.formats.load_scene` takes it.

    Returns:
        The number; None where there is no such scene.
    """
    given = without_level(path)
    try:
        if given.name.lower() in registry.format_of(Path(path)).names:
            given = given.parent
    except UsageError:
        pass
    try:
        if not os.path.isdir(given):
            return os.stat(given).st_size if os.path.isfile(given) else None
        parts = (file for file in given.rglob("*") if file.suffix.lower() in _PARTS and file.is_file())
        return sum(file.stat().st_size for file in parts) or None
    except (OSError, ValueError):
        return None
