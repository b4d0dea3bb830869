"""The folder in the user's cache that compiled kernels and the list of OpenCL runtimes lie in: :func:`cache_folder`.

What lies there is loaded as code, so nobody else may be able to write to it, or to put another folder in its place.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

import platformdirs


def cache_folder(name: str) -> Path | None:
    """A folder of this name that only this user can write to, made where it is missing; None if there can be none.

    Args:
        name: of the folder, in the package's own in the user's cache.
    """
    try:
        path = Path(os.path.realpath(platformdirs.user_cache_dir("potr_cl", "potr_cl")))
        for folder in (path, path / name):
            folder.mkdir(0o700, parents=True, exist_ok=True)
        path /= name
        return path if is_private(path) and os.access(path, os.W_OK | os.X_OK) else None
    except (OSError, RuntimeError, ValueError):  # no home, a loop of links, a null character
        return None


def is_private(folder: Path) -> bool:
    """Whether a folder is this user's and no link, and nobody else can write to it or exchange it.

    Args:
        folder: an absolute path; only its last part may be a link.
    """
    if os.name != "posix":
        return True  # a profile of Windows is private by itself
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        return False
    # Within a container the machine's administrator may have another number.
    trusted = {os.getuid(), 0, os.stat("/").st_uid}
    above = [each.lstat() for each in folder.parents]
    return all(
        each.st_uid in trusted and (not each.st_mode & stat.S_IWOTH or each.st_mode & stat.S_ISVTX) for each in above
    )
