"""What the formats that the library gsply reads and writes share: the library itself, its arrays, its errors."""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from collections.abc import Iterator
from typing import Any

import numpy as np

from potr_cl.codec import octree
from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.formats.declaration import install_command
from potr_cl.model.scene import Scene

_log = logging.getLogger("potr_cl")

#: Of this package, which brings the library.
EXTRA = "convert"

_LARGEST_LOGIT = np.float32(20)


def library(path: str | os.PathLike[str]) -> Any:
    """The module gsply, which ``path`` needs.

    Raises:
        UsageError: it is not installed.
    """
    try:
        import gsply
        import gsply.sog_reader
        import gsply.spz
    except ImportError as error:
        raise UsageError(
            f"'{path}': this kind of file needs the library gsply, which cannot be loaded ({_one_line(error)}): "
            f"{install_command(EXTRA)}"
        ) from None
    return gsply


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
        raise DataError(f"'{path}' is damaged or of another kind: {_one_line(error)}") from error


def to_scene(path: str | os.PathLike[str], data: Any) -> Scene:
    """gsply's arrays, in its PLY convention, as a clean scene.

    Args:
        path: for messages.
        data: a ``GSData``: logarithmic scales, logits, quaternions w first, ``shN`` (N, K, 3) or None.

    Raises:
        DataError: no splat is left.
    """

    def single(array: Any) -> Any:
        return np.ascontiguousarray(array, dtype=np.float32)

    count = len(data.means)
    sh = np.empty((count, 1 + (0 if data.shN is None else data.shN.shape[1]), 3), np.float32)
    sh[:, 0] = data.sh0
    if sh.shape[1] > 1:
        sh[:, 1:] = data.shN
    scene = Scene(
        single(data.means), single(data.scales), single(data.quats), single(data.opacities).reshape(count), sh
    )
    try:
        scene, report = scene.cleaned()
    except DataError as error:
        raise DataError(f"'{path}': {error}") from error
    if report.non_finite:
        _log.warning("'%s': dropped %d splats with non-finite values", path, report.non_finite)
    if report.zero_quaternions:
        _log.warning("'%s': turned %d quaternions of length zero into no rotation", path, report.zero_quaternions)
    return scene


def from_scene(gsply: Any, scene: Scene) -> Any:
    """A scene as gsply's arrays, with unit quaternions, its splats in an order that keeps neighbours together.

    A compressed PLY has one set of bounds for 256 splats in sequence: in a trainer's order they span the scene.
    """
    side = float(np.ptp(scene.means, axis=0).max())
    scene = scene.subset(octree.build(scene.means, max(side * 2.0**-20, 1e-30))[1])
    quaternions = scene.quaternions / np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
    return gsply.GSData.from_arrays(
        means=np.ascontiguousarray(scene.means),
        scales=np.ascontiguousarray(scene.log_scales),
        quats=quaternions,
        # Eight bits cannot tell anything beyond from 0 or 1, and gsply would overflow.
        opacities=np.clip(scene.opacity_logits, -_LARGEST_LOGIT, _LARGEST_LOGIT),
        sh0=np.ascontiguousarray(scene.sh[:, 0]),
        shN=np.ascontiguousarray(scene.sh[:, 1:]) if scene.sh_degree else None,
        format="ply",
    )


def _one_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
