"""What the camera formats have in common: JSON input, checked values, names of views, the every-8th test split; and the
points of the reconstruction that cameras come from: COLMAP's points3D, or the input.ply of the original 3DGS.
"""

from __future__ import annotations

import collections
import json
import logging
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.host.inputs import unchanged
from potr_cl.model.camera import Camera
from potr_cl.model.lens import MOST_HALF_FIELD, Lens, Pinhole, coverings

_log = logging.getLogger("potr_cl")

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".exr", ".heic"})

MAX_JSON_BYTES = 256 << 20  # some 400 000 views
_MAX_SIDE = 1 << 16


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        UsageError: it cannot be opened or read.
        DataError: it was changed meanwhile.
    """
    try:
        with path.open("rb") as file, unchanged(path, file):
            return file.read()
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from error


def read_json(path: Path) -> Any:
    """The value that a JSON file holds.

    Raises:
        UsageError: it cannot be opened.
        DataError: it is no JSON.
    """
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from error
    if size > MAX_JSON_BYTES:
        raise DataError(f"'{path}' is too large for a camera file: {size} bytes, at most {MAX_JSON_BYTES} are read")
    try:
        return json.loads(read_bytes(path))
    except RecursionError as error:
        raise DataError(f"'{path}' is nested too deeply for a camera file") from error
    except ValueError as error:
        raise DataError(f"'{path}' is not valid JSON: {error}") from error


def number(value: Any, where: str) -> float:
    """A finite number of a JSON file.

    Args:
        value: what the file holds.
        where: names file, view and key for the message.

    Raises:
        DataError: it is something else.
    """
    try:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(float(value)):
            return float(value)
    except OverflowError:
        pass
    raise DataError(f"{where} is {excerpt(value)}, not a finite number")


def image_side(value: Any, where: str) -> int:
    """A width or height in pixels; see :func:`number`."""
    side = number(value, where)
    if side != int(side) or not 1 <= side <= _MAX_SIDE:
        raise DataError(f"{where} is {excerpt(value)}, not a number of pixels from 1 to {_MAX_SIDE}")
    return int(side)


def matrix(value: Any, shapes: Sequence[tuple[int, ...]], where: str) -> NDArray[np.float64]:
    """Nested lists of finite numbers, of one of the given shapes; see :func:`number`."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        array = np.empty(())
    if array.shape not in shapes:
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise DataError(f"{where} is {excerpt(value)}, not {wanted} numbers")
    if not np.isfinite(array).all():
        raise DataError(f"{where} holds a non-finite value")
    return array


def image_name(value: Any, where: str) -> str:
    """The name of an image file: not empty, and printable, for it becomes part of messages and of file names.

    Raises:
        DataError: it is something else.
    """
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise DataError(f"{where} is {excerpt(value)}, not the name of an image")
    return value.replace("\\", "/")


def stem(file: str) -> str:
    """The name of an image without its extension; a name may have dots without having an extension."""
    suffix = Path(file).suffix
    return file[: -len(suffix)] if suffix.lower() in IMAGE_SUFFIXES else file


def camera_of(path: Path, **fields: Any) -> Camera:
    """A camera; if its values belong to none, the message names the file that they come from."""
    try:
        with np.errstate(all="ignore"):  # a damaged pose may overflow while it is checked
            return Camera(**fields)
    except DataError as error:
        raise DataError(f"'{path}', {error}") from error


@dataclass(frozen=True)
class FoundView:
    """A view as a file describes it.

    Attributes:
        path: of the file, and ``name`` which of its views it is, for messages.
        frame: size, focal lengths and principal point of the photograph, as :func:`camera_of` takes them.
        distortion: what :func:`lens_coefficients` gives.
        rest: what :func:`camera_of` takes besides.
    """

    path: Path
    name: str
    frame: dict[str, Any]
    distortion: dict[str, Any] | None
    rest: dict[str, Any]

    @property
    def where(self) -> str:
        """For messages."""
        return f"'{self.path}', {self.name}"


def cameras_of(path: Path, views: Sequence[FoundView]) -> list[Camera]:
    """Cameras of views, of distorted photographs pinhole views that cover their fields; logs one line about these.

    Args:
        path: what they come from, for the line.
        views: as they were found.

    Raises:
        DataError: a lens or a camera has values that are none's, or would have more pixels on a side than are read.
    """
    lenses: dict[Lens, str] = {}  # views mostly share one, and reconstructions can have one for each
    of_views: list[Lens | None] = []
    for view in views:
        try:
            lens = None if view.distortion is None else Lens(**view.frame, **view.distortion)
        except DataError as error:
            raise DataError(f"{view.where}: {error}") from error
        of_views.append(lens)
        if lens is not None:
            lenses.setdefault(lens, view.where)
    covered: dict[Lens, tuple[Pinhole, bool]] = {}
    for (lens, where), found in zip(lenses.items(), coverings(list(lenses)), strict=True):
        if isinstance(found, DataError):
            raise DataError(f"{where}: {found}")
        width, height = found[0][:2]
        if max(width, height) > _MAX_SIDE:
            raise DataError(f"{where}: a pinhole view of its field has {width} x {height} pixels, too many")
        covered[lens] = found
    _tell_of_lenses(path, [None if lens is None else covered[lens][1] for lens in of_views])
    seen = [{} if lens is None else covered[lens][0]._asdict() | {"lens": lens} for lens in of_views]
    return [camera_of(view.path, **view.rest, **(view.frame | each)) for view, each in zip(views, seen, strict=True)]


def lens_coefficients(values: Mapping[str, float], fisheye: bool) -> dict[str, Any] | None:
    """The coefficients of a :class:`Lens` from k1 …, q1 …, p1, p2, s1 and s2, where missing ones are 0.

    Returns:
        What it takes besides size and intrinsics; None for a pinhole.
    """

    def series(letter: str, most: int) -> tuple[float, ...]:
        found = [values.get(f"{letter}{number}", 0.0) for number in range(1, most + 1)]
        while found and not found[-1]:
            found.pop()
        return tuple(found)

    radial, quotient = series("k", 4), series("q", 3)
    tangential, prism = ((values.get(f"{letter}1", 0.0), values.get(f"{letter}2", 0.0)) for letter in "ps")
    if not (fisheye or radial or quotient or any(tangential) or any(prism)):
        return None
    return {"fisheye": fisheye, "radial": radial, "quotient": quotient, "tangential": tangential, "prism": prism}


def _tell_of_lenses(path: Path, whole: Sequence[bool | None]) -> None:
    """Log one line if views have lens distortion: None has not, and True says that all of its field is covered."""
    bent, cut = sum(each is not None for each in whole), whole.count(False)
    if not bent:
        return
    widest = 2 * math.degrees(MOST_HALF_FIELD)
    beyond = f"; of {cut} the edges are left out, beyond {widest:.0f} degrees or what the lens's formula describes"
    _log.warning(
        "'%s': %d of %d views have lens distortion: replaced by pinhole views that cover the same area%s",
        path, bent, len(whole), beyond if cut else "",
    )  # fmt: skip


def view_names(files: Sequence[str], path: Path) -> list[str]:
    """Names of views from the names of their images: without folder and extension where that tells them apart.

    Args:
        files: names of the images, relative to a common folder.
        path: of the camera file, for the message.

    Raises:
        DataError: two views share one image.
    """
    whole = [os.path.normpath(file) for file in files]
    stems = [stem(file) for file in whole]
    for names in ([Path(s).name for s in stems], stems, whole):
        if len(set(names)) == len(names):
            return names
    twice = collections.Counter(whole).most_common(1)[0][0]
    raise DataError(f"'{path}': more than one view has the image '{twice}': keep one of them")


def every_eighth(files: Sequence[str]) -> list[str]:
    """The test split that the field uses: each 8th image by sorted name, from the first on (Barron et al. 2022)."""
    test = set(sorted(files)[::8])
    return ["test" if f in test else "train" for f in files]


def excerpt(value: Any) -> str:
    """A value that may be of any size and kind, short enough for a message."""
    if value is None:
        return "missing"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return f"an object of {len(value)} keys"
    if isinstance(value, int) and value.bit_length() > 64:
        return "a number of more than 64 bits"
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


_COUNT = struct.Struct("<Q")
_POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, length of the track; then the track
_TRACK_BYTES = 8


def points_beside(folder: Path, *names: str) -> Path | None:
    """The first file of these names in a folder."""
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_points(path: Path) -> NDArray[np.float64]:
    """Positions of points, (P, 3) in world units.

    Args:
        path: of points3D.bin, points3D.txt, or a PLY.

    Raises:
        UsageError: it cannot be opened.
        DataError: it is damaged.
    """
    read = {".bin": _binary, ".txt": _text}.get(path.suffix, _ply)
    try:
        points = np.array(list(read(path)), np.float64).reshape(-1, 3)
    except (struct.error, ValueError, KeyError, IndexError) as error:
        raise DataError(f"'{path}' has no points of a reconstruction: {error}") from error
    return points[np.isfinite(points).all(axis=1)]


def _binary(path: Path) -> Iterator[tuple[float, ...]]:
    data = read_bytes(path)
    offset = _COUNT.size
    for _ in range(_COUNT.unpack_from(data)[0]):
        _, *values, track = _POINT.unpack_from(data, offset)
        yield tuple(values[:3])
        offset += _POINT.size + _TRACK_BYTES * track


def _text(path: Path) -> Iterator[tuple[float, ...]]:
    for line in read_bytes(path).splitlines():
        if line and not line.startswith(b"#"):
            _, x, y, z = line.split(maxsplit=4)[:4]
            yield float(x), float(y), float(z)


def _ply(path: Path) -> Iterator[tuple[float, ...]]:
    from plyfile import PlyData, PlyParseError

    try:
        vertices = PlyData.read(path)["vertex"]
    except (OSError, PlyParseError) as error:
        raise DataError(f"cannot read '{path}': {error}") from error
    yield from zip(*(vertices[axis].tolist() for axis in "xyz"), strict=True)
