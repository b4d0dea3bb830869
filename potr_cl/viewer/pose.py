"""The browser's camera as a :class:`~potr_cl.model.camera.Camera` (:func:`camera_of`), and a view for the browser
(:func:`gaze_on`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gaze:
    """Where a browser's camera stands and looks; axes as in OpenCV.

    Attributes:
        position: (3,) float64, world units.
        rotation: (3, 3) float64, camera to world: its columns are right, down and forward.
        fov: vertical angle of the whole picture, radians.
    """

    position: F64
    rotation: F64
    fov: float

    def is_near(self, other: Gaze) -> bool:
        """Whether both show the same, but for what is lost on the way through the browser, which counts in float32."""
        return (
            self.stands_with(other)
            and float(np.abs(self.rotation - other.rotation).max()) < 2e-3
            and abs(self.fov - other.fov) < 2e-3
        )

    def stands_with(self, other: Gaze) -> bool:
        """Whether both stand in the same place, wherever they look."""
        far = float(np.linalg.norm(self.position)) + 1.0
        return float(np.abs(self.position - other.position).max()) < 1e-4 * far


def camera_of(gaze: Gaze, width: int, height: int) -> Camera:
    """A camera of square pixels that looks through the middle of its picture.

    Args:
        gaze: of the browser.
        width, height: of the picture in pixels.
    """
    # What came through a browser is a rotation in float32 only.
    left, _, right = np.linalg.svd(gaze.rotation)
    rotation = (left @ right).T
    focal = height / (2 * math.tan(gaze.fov / 2))
    return Camera(
        "view", width, height, focal, focal, width / 2, height / 2, rotation, -rotation @ gaze.position, "test"
    )


def gaze_on(camera: Camera, aspect: float) -> Gaze:
    """Where the browser has to look so that its picture holds all of a view's.

    Args:
        camera: the view; its principal point may lie anywhere.
        aspect: width of the browser's picture by its height.
    """
    across = max(camera.cx, camera.width - camera.cx) / camera.fx
    down = max(camera.cy, camera.height - camera.cy) / camera.fy
    return Gaze(camera.centre, camera.rotation.T.copy(), 2 * math.atan(max(down, across / aspect)))


@dataclass(frozen=True)
class Place:
    """Where one view's picture lies in another's, which stands at the same place and looks the same way.

    Attributes:
        left, top, right, bottom: whole pixels of the picture that holds it.
        box: the same rectangle in pixels of the picture that is held, for :meth:`PIL.Image.Image.resize`.
    """

    left: int
    top: int
    right: int
    bottom: int
    box: tuple[float, float, float, float]


def place_in(inner: Camera, outer: Camera) -> Place | None:
    """Where a view's picture lies in that of another with the same pose; None where they have no pixel in common."""
    x_scale, y_scale = outer.fx / inner.fx, outer.fy / inner.fy
    x_start, y_start = outer.cx - inner.cx * x_scale, outer.cy - inner.cy * y_scale
    # Pixels that the inner picture covers whole, but for what float32 took from a rectangle that fits exactly.
    slack = 0.05
    left, top = max(math.ceil(x_start - slack), 0), max(math.ceil(y_start - slack), 0)
    right = min(math.floor(x_start + inner.width * x_scale + slack), outer.width)
    bottom = min(math.floor(y_start + inner.height * y_scale + slack), outer.height)
    if right <= left or bottom <= top:
        return None

    def inside(value: float, most: int) -> float:
        return min(max(value, 0.0), float(most))

    return Place(
        left,
        top,
        right,
        bottom,
        (
            inside((left - x_start) / x_scale, inner.width),
            inside((top - y_start) / y_scale, inner.height),
            inside((right - x_start) / x_scale, inner.width),
            inside((bottom - y_start) / y_scale, inner.height),
        ),
    )


def rotation_of(wxyz: F64) -> F64:
    """(3, 3) of a quaternion, (4,) with w first, of any length but 0."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
