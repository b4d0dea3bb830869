"""What the scene formats have in common: sizes of files, a library's errors as ours, clean scenes."""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from collections.abc import Iterator

from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.model.scene import Scene

_log = logging.getLogger("potr_cl")


def file_size(path: str | os.PathLike[str]) -> int:
    """Bytes of a regular file.

    Raises:
        UsageError: there is none at ``path``.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot open '{path}': {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(status.st_mode):
        raise UsageError(f"'{path}' is not a regular file")
    return status.st_size


@contextlib.contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever a library raises over a bad file into a DataError."""
    try:
        yield
    except (PotrError, MemoryError):
        raise
    except PermissionError as error:
        raise UsageError(f"cannot open '{path}': {error.strerror}") from error
    except Exception as error:
        raise DataError(f"'{path}' is damaged or of another kind: {first_line(error)}") from error


def cleaned(path: str | os.PathLike[str], scene: Scene) -> Scene:
    """A scene that was read, finite throughout; what had to be dropped or mended is reported to the log "potr_cl".

    Raises:
        DataError: no splat is left.
    """
    try:
        scene, report = scene.cleaned()
    except DataError as error:
        raise DataError(f"'{path}': {error}") from error
    if report.non_finite:
        _log.warning("'%s': dropped %d splats with non-finite values", path, report.non_finite)
    if report.infinite_opacities:
        _log.warning("'%s': made %d infinite opacity logits finite", path, report.infinite_opacities)
    if report.zero_quaternions:
        _log.warning("'%s': turned %d quaternions of length zero into no rotation", path, report.zero_quaternions)
    return scene


def first_line(error: BaseException) -> str:
    """What a library says of an error, for a message of one line."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
