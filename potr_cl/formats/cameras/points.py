"""Points of the reconstruction that cameras come from: COLMAP's points3D, or the input.ply of the original 3DGS."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.formats.cameras.view_files import read_bytes

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
