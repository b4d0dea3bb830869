"""What the camera formats have in common: JSON input, checked values, names of views, the every-8th test split."""

from __future__ import annotations

import collections
import functools
import json
import logging
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.host.unchanged import unchanged
from potr_cl.model.camera import Camera
from potr_cl.model.lens import MOST_HALF_FIELD, Lens, Pinhole

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


@functools.lru_cache(maxsize=64)
def lens_of(**values: Any) -> Lens:
    """A lens; views mostly share one.

    Raises:
        DataError: the values are no lens's.
    """
    return Lens(**values)


@functools.lru_cache(maxsize=64)
def _covering(lens: Lens) -> tuple[Pinhole, bool]:
    return lens.covering()


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


def pinhole_fields(lens: Lens) -> dict[str, Any]:
    """What :func:`camera_of` takes of a view that covers the field of a distorted photograph.

    Raises:
        DataError: the view would have more pixels on a side than are read.
    """
    view, _ = _covering(lens)
    if max(view.width, view.height) > _MAX_SIDE:
        raise DataError(f"a pinhole view of its field has {view.width} x {view.height} pixels, too many")
    return {**view._asdict(), "lens": lens}


def tell_of_lenses(path: Path, cameras: Sequence[Camera]) -> None:
    """Log one line if views have lens distortion."""
    lenses = [camera.lens for camera in cameras if camera.lens is not None]
    if not lenses:
        return
    cut = sum(not _covering(lens)[1] for lens in lenses)
    widest = 2 * math.degrees(MOST_HALF_FIELD)
    beyond = f"; of {cut} the edges are left out, beyond {widest:.0f} degrees or what the lens's formula describes"
    _log.warning(
        "'%s': %d of %d views have lens distortion: replaced by pinhole views that cover the same area%s",
        path, len(lenses), len(cameras), beyond if cut else "",
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
