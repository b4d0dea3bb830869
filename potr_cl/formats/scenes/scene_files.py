"""What the scene formats have in common: opening files, a library's errors as ours, clean scenes, order for writing."""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import replace
from typing import BinaryIO

import numpy as np

from potr_cl.codec import octree
from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.model.scene import CleanReport, Scene

#: Where somebody wants to know what was mended in files that are read.
_MENDED: ContextVar[list[CleanReport] | None] = ContextVar("mended", default=None)

_log = logging.getLogger("potr_cl")

#: Eight bits cannot tell anything beyond from an opacity of 0 or 1.
_LARGEST_LOGIT = np.float32(20)
_LONG = np.float32(1e15)
#: In formats of other tools a splat takes several bytes; of more than this a byte no scene is made.
MOST_A_BYTE = 1


@contextlib.contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[tuple[BinaryIO, int]]:
    """A regular file that is open for reading, and its size in bytes; whatever is raised over it is an error of ours.

    Raises:
        UsageError: there is none at ``path``, or it cannot be opened.
        DataError: anything but memory failed while it was read.
    """
    try:
        file = open(path, "rb")  # noqa: SIM115
    except IsADirectoryError as error:
        raise UsageError(f"'{path}' is not a regular file") from error
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot open '{path}': {getattr(error, 'strerror', None) or error}") from error
    with file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise UsageError(f"'{path}' is not a regular file")
        try:
            yield file, status.st_size
        except (PotrError, MemoryError):
            raise
        except Exception as error:  # a library raises what its parts happen to raise
            raise DataError(f"'{path}' is damaged or of another kind: {first_line(error)}") from error


@contextlib.contextmanager
def noting_mends() -> Iterator[list[CleanReport]]:
    """Of all scenes that are read within the block, what had to be mended; the log is not told of it then."""
    mended: list[CleanReport] = []
    token = _MENDED.set(mended)
    try:
        yield mended
    finally:
        _MENDED.reset(token)


def cleaned(path: str | os.PathLike[str], scene: Scene) -> Scene:
    """A scene that was read, finite throughout; what had to be dropped or mended is reported to the log "potr_cl".

    Raises:
        DataError: no splat is left.
    """
    try:
        scene, report = scene.cleaned()
    except DataError as error:
        raise DataError(f"'{path}': {error}") from error
    noted = _MENDED.get()
    if noted is not None:
        noted.append(report)
        return scene
    if report.non_finite:
        _log.warning("'%s': dropped %d splats with non-finite values", path, report.non_finite)
    if report.infinite_opacities:
        _log.warning("'%s': made %d infinite opacity logits finite", path, report.infinite_opacities)
    if report.zero_quaternions:
        _log.warning("'%s': turned %d quaternions of length zero into no rotation", path, report.zero_quaternions)
    return scene


def arranged(scene: Scene) -> Scene:
    """A scene as coarse formats want it: unit quaternions, opacities that bytes can tell, neighbours together.

    A compressed PLY has one set of bounds for 256 splats in sequence: in a trainer's order they span the scene.
    """
    side = max(float(axis.max()) - float(axis.min()) for axis in scene.means.T)
    scene = scene.subset(octree.build(scene.means, max(side * 2.0**-20, 1e-30))[1])
    quaternions = scene.quaternions
    largest = np.abs(quaternions).max(axis=1, keepdims=True)
    if (long := largest > _LONG).any():  # the square of its length would be infinite
        quaternions = np.where(long, quaternions / largest, quaternions)
    return replace(
        scene,
        quaternions=quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        opacity_logits=np.clip(scene.opacity_logits, -_LARGEST_LOGIT, _LARGEST_LOGIT),
    )


def first_line(error: BaseException) -> str:
    """What a library says of an error, for a message of one line."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
