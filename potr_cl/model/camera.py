"""Camera: a pinhole view of a scene, and the split into training and test views."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.model.lens import Lens, Pinhole

Split = str  # "train" or "test"
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera, axes as in OpenCV and COLMAP (x right, y down, z forward).

    A world point μ has view coordinates ``t = rotation @ μ + translation`` and the pixel position
    ``(fx · t_x / t_z + cx, fy · t_y / t_z + cy)``; the centre of pixel (i, j) is at (i + 0.5, j + 0.5).

    Attributes:
        name: of the view; by convention its image's name without folder and extension.
        width, height: of the image in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
        rotation: (3, 3) float64, world to camera.
        translation: (3,) float64, world to camera, world units.
        split: "train" (the encoder may look at it) or "test" (for judging only).
        image_path: the photograph, if the camera file names one.
        points_path: points of the reconstruction that the pose comes from, in the same frame, if they lie beside it.
        lens: how the photograph was bent, if it was; None: the photograph is what the pinhole sees.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    split: Split = "train"
    image_path: Path | None = None
    lens: Lens | None = None
    points_path: Path | None = None

    def __post_init__(self) -> None:
        where = f"camera '{self.name}'"
        self._take("rotation", lambda value: np.asarray(value, np.float64), "an array of numbers")
        self._take("translation", lambda value: np.asarray(value, np.float64), "an array of numbers")
        for name in ("width", "height"):
            self._take(name, _whole, "a whole number of pixels")
        for name in ("fx", "fy", "cx", "cy"):
            self._take(name, float, "a number of pixels")
        if self.width < 1 or self.height < 1:
            raise DataError(f"{where}: image size {self.width} x {self.height} is not positive")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not np.isfinite(intrinsics).all() or self.fx <= 0 or self.fy <= 0:
            raise DataError(f"{where}: intrinsics (fx, fy, cx, cy) = {intrinsics} are not a pinhole camera's")
        if self.rotation.shape != (3, 3) or self.translation.shape != (3,):
            raise DataError(f"{where}: the pose is not a 3 x 3 rotation and a translation of 3")
        if not (np.isfinite(self.rotation).all() and np.isfinite(self.translation).all()):
            raise DataError(f"{where}: the pose holds a non-finite value")
        # Files round to 6 or 7 digits; anything worse is a scale or a shear, which a pinhole pose cannot hold.
        with np.errstate(over="ignore", invalid="ignore"):
            skew = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if not skew <= 1e-3 or np.linalg.det(self.rotation) < 0:
            raise DataError(f"{where}: the pose's 3 x 3 part is not a rotation")
        if self.split not in ("train", "test"):
            raise DataError(f"{where}: split '{self.split}' is neither 'train' nor 'test'")

    def _take(self, name: str, made: Callable[[Any], Any], kind: str) -> None:
        """Make an attribute what it should be, of what stands for it as well."""
        value = getattr(self, name)
        try:
            object.__setattr__(self, name, made(value))
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(f"camera '{self.name}': {name} is {type(value).__name__}, not {kind}") from error

    def __repr__(self) -> str:
        at = ", ".join(f"{x:.3g}" for x in self.centre)
        view = 2 * math.degrees(math.atan(self.width / 2 / self.fx))
        return f"Camera('{self.name}', {self.split}, {self.width} x {self.height}, {view:.0f}° wide, at ({at}))"

    @property
    def photograph_size(self) -> tuple[int, int]:
        """Width and height of the photograph in pixels."""
        return (self.width, self.height) if self.lens is None else (self.lens.width, self.lens.height)

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) position of the camera centre in world units."""
        return -self.rotation.T @ self.translation


def _whole(value: Any) -> int:
    if int(value) != value:
        raise ValueError
    return int(value)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The same view in another number of pixels; a photograph of it does not fit any more."""
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=camera.cx * across,
        cy=camera.cy * down,
        image_path=None,
    )


def spread_evenly(views: Sequence[T], most: int) -> list[T]:
    """So many of some views at most, from the first to the last."""
    return [views[k] for k in np.linspace(0, len(views) - 1, min(len(views), most)).round().astype(int)]


def train_views(cameras: Sequence[Camera]) -> list[Camera]:
    """The views that the encoder may look at. Raises UsageError if there is none."""
    views = [c for c in cameras if c.split == "train"]
    if not views:
        raise UsageError("none of the cameras is a training view: encoding looks at training views only")
    return views


def test_views(cameras: Sequence[Camera]) -> list[Camera]:
    """The views kept for judging; may be empty."""
    return [c for c in cameras if c.split == "test"]


test_views.__test__ = False  # type: ignore[attr-defined]  # pytest would collect it by its name


def within_photographs(cameras: Sequence[Camera]) -> list[Camera]:
    """The same cameras, each looking at no more than what its photograph shows: for comparing with photographs.

    Only views with a lens are changed: they cover the field of the photograph, and its undistorted picture has gaps
    there.

    Raises:
        DataError: no pinhole view lies within a photograph.
    """
    views: dict[Lens, Pinhole] = {}
    for camera in cameras:
        if camera.lens is not None and camera.lens not in views:
            try:
                views[camera.lens] = camera.lens.within()
            except DataError as error:
                raise DataError(f"camera '{camera.name}': {error}") from error
    return [c if c.lens is None else replace(c, **views[c.lens]._asdict()) for c in cameras]


def camera_centres(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """(S, 3) positions of the camera centres in world units."""
    return np.array([c.centre for c in cameras], dtype=np.float64).reshape(-1, 3)


def focus(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """(3,) the point in world units that the lines of sight of some cameras come nearest to, by least squares."""
    across = np.eye(3) - np.stack([np.outer(c.rotation[2], c.rotation[2]) for c in cameras])
    point: NDArray[np.float64] = np.linalg.lstsq(
        across.sum(axis=0), np.einsum("nij,nj->i", across, camera_centres(cameras)), rcond=1e-9
    )[0]
    return point
