"""What the scene formats have in common: opening files, levels of detail in paths, a library's errors as ours, clean
scenes, order for writing.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import stat
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree
from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.host.inputs import check_claim, is_device_of_windows, refuse_lfs_pointer, unchanged
from potr_cl.model.scene import LOW_PASS, CleanReport, FloatArray, Scene

#: Where somebody wants to know what was mended in files that are read.
_MENDED: ContextVar[list[CleanReport] | None] = ContextVar("mended", default=None)

_log = logging.getLogger("potr_cl")

#: Eight bits cannot tell anything beyond from an opacity of 0 or 1.
_LARGEST_LOGIT = np.float32(20)
_LONG = np.float32(1e15)
#: Characters of a value out of a file that a message shows.
_LONGEST_SAID = 60
#: Logarithm of a standard deviation that no picture shows, for splats that are flat.
NO_EXTENT = np.float32(np.log(1e-9))
#: As other tools read an opacity of 0 or 1 that a byte holds.
_LEAST_OPACITY = np.float32(1e-6)
#: The SH basis function of degree 0: of formats that hold colours.
SH_0 = 0.28209479177387814
#: In formats of other tools a splat takes several bytes; of more than this a byte no scene is made.
_MOST_A_BYTE = 1


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
        with unchanged(path, file), reading(path):
            yield file, status.st_size


@contextlib.contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Of a block that reads a file: whatever is raised in it is an error of ours.

    Raises:
        DataError: anything but memory failed.
    """
    try:
        yield
    except (PotrError, MemoryError):
        raise
    except Exception as error:  # a library raises what its parts happen to raise
        raise DataError(f"'{path}' is damaged or of another kind: {first_line(error)}") from error


def file_in_folder(path: str | os.PathLike[str], name: str) -> Path | None:
    """The file ``name`` that a path means, which may be its own or that of the folder it is in; None for another file.

    Args:
        path: as the user gave it.
        name: of the file, in lower case.
    """
    given = Path(path)
    if given.name.lower() == name and not os.path.isdir(given):
        return given
    return given / name if os.path.isfile(given / name) else None


def related(file: Path, name: object, windows: bool = os.name == "nt") -> Path:
    """A file that ``file`` names, beside it or in a folder below.

    Raises:
        DataError: the name is none, or leads out of the folder, or to a device of Windows; or there is a Git-LFS
            pointer in the file's place.
    """
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or not all(part.isprintable() for part in parts) or {"..", "/", "//"} & set(parts):
        raise DataError(f"'{file}' is damaged: it names a file {shown(name)}")
    elsewhere = windows and any(":" in part or is_device_of_windows(part) for part in parts)
    if elsewhere or PureWindowsPath(*parts).drive or any("\\" in part for part in parts):
        raise DataError(f"'{file}' is damaged: it names a file {shown(name)}")
    found = file.parent.joinpath(*parts)
    refuse_lfs_pointer(found)
    return found


def shown(value: object) -> str:
    """A value out of a file, for a message: not long."""
    said = repr(value)
    return said if len(said) <= _LONGEST_SAID else said[:_LONGEST_SAID] + "…"


def joined(scenes: list[Scene]) -> Scene:
    """Scenes as one; those of a lower SH degree get coefficients of zero.

    It is antialiased if all are, alike; as in splat-transform, it is classic where they differ.

    Args:
        scenes: at least one.
    """
    if not scenes[1:]:
        return scenes[0]
    most = max(scene.sh.shape[1] for scene in scenes)
    sh = np.zeros((sum(map(len, scenes)), most, 3), np.float32)
    start = 0
    for scene in scenes:
        sh[start : start + len(scene), : scene.sh.shape[1]] = scene.sh
        start += len(scene)
    alike = len({(scene.antialiased, scene.low_pass) for scene in scenes}) == 1
    return replace(
        scenes[0].rendered(None if alike else False),
        means=np.concatenate([scene.means for scene in scenes]),
        log_scales=np.concatenate([scene.log_scales for scene in scenes]),
        quaternions=np.concatenate([scene.quaternions for scene in scenes]),
        opacity_logits=np.concatenate([scene.opacity_logits for scene in scenes]),
        sh=sh,
    )


def check_splats(path: str | os.PathLike[str], splats: int, nbytes: int, trust: bool) -> None:
    """Refuse so many splats in files of so many bytes, as :func:`potr_cl.host.inputs.check_claim` does.

    Raises:
        DataError: they are beyond belief, and the user does not vouch for the file.
    """
    try:
        check_claim(splats, nbytes, _MOST_A_BYTE, trust)
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None


def byte_logits() -> FloatArray:
    """(256,) float32, the logit of each byte's opacity; those of 0 and 1 are what eight bits cannot tell from them."""
    opacities = np.clip(np.arange(256).astype(np.float32) / np.float32(255), _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    return natural_logarithm(opacities / (np.float32(1) - opacities))


#: The parts of w, x, y, z that are stored where the largest is not, by its number.
OTHER_PARTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def with_largest(largest: NDArray[np.intp], others: NDArray[np.floating], places: NDArray[np.intp]) -> FloatArray:
    """(n, 4) float32 unit quaternions of which three parts are known.

    Args:
        largest: (n,) which part is not: the largest.
        others: (n, 3) the three, in the precision to compute with.
        places: (4, 3) where these belong, for each number of the largest.
    """
    quaternions = np.empty((len(others), 4), np.float32)
    np.put_along_axis(quaternions, places[largest], others.astype(np.float32, copy=False), axis=1)
    squares = others * others
    rest = np.sqrt(np.maximum(1 - (squares[:, 0] + squares[:, 1] + squares[:, 2]), 0))
    np.put_along_axis(quaternions, largest[:, None], rest.astype(np.float32, copy=False)[:, None], axis=1)
    return quaternions


def log_of_scales(scales: FloatArray) -> FloatArray:
    """Logarithms of standard deviations, (N, 3); splats without extent get one that no picture shows.

    Negative ones have no logarithm: NaN, so that their splats are dropped.
    """
    flat = np.maximum(scales.reshape(-1), np.exp(NO_EXTENT))
    return np.where(scales >= 0, natural_logarithm(flat).reshape(scales.shape), np.float32(np.nan))


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


def tell_of_low_pass(path: str | os.PathLike[str], scene: Scene) -> None:
    """Say that a format which knows only the usual low-pass filter cannot hold a scene's own."""
    if scene.low_pass != LOW_PASS:
        _log.warning(
            "'%s': this format cannot say that the scene has a low-pass filter of %g square pixels, as Mip-Splatting's "
            "have: it will be drawn with the usual %g, a little softer",
            path,
            scene.low_pass,
            LOW_PASS,
        )


def arranged(scene: Scene) -> Scene:
    """A scene as coarse formats want it: unit quaternions, opacities that bytes can tell, neighbours together."""
    side = max(float(axis.max()) - float(axis.min()) for axis in scene.means.T)
    return unit_quaternions(scene.subset(octree.leaf_order(scene.means, max(side * 2.0**-20, 1e-30))))


def unit_quaternions(scene: Scene) -> Scene:
    """A scene as bytes can tell it: unit quaternions, and opacities that are not nearer to 0 or 1 than they say."""
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
