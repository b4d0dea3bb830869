"""Cameras that are in a scene's frame and such that are not: what :mod:`potr_cl.model.agreement` is judged by.

:func:`moved` turns, mirrors, scales and shifts a scene as programs that edit scenes do, colours included.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.quaternions import quaternions_of
from potr_cl.model.scene import Scene
from potr_cl.model.sh_rotation import rotated_sh
from potr_cl.placement.virtual import place_cameras
from tests.reference.captures import looking
from tests.reference.raster import rotation_matrices

F64 = NDArray[np.float64]

#: What programs and people do to scenes: axes, scale, shift in world units. Cameras all around a thing see it from all
#: sides after a turn about the vertical, too: no such turn is here.
MOTIONS: dict[str, tuple[F64, float, tuple[float, float, float]]] = {
    "turned by 180 degrees about x": (np.diag([1.0, -1.0, -1.0]), 1.0, (0, 0, 0)),
    "turned by 180 degrees about y": (np.diag([-1.0, 1.0, -1.0]), 1.0, (0, 0, 0)),
    "turned by 90 degrees about x": (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), 1.0, (0, 0, 0)),
    "mirrored along z": (np.diag([1.0, 1.0, -1.0]), 1.0, (0, 0, 0)),
    "shifted by 8 along x": (np.eye(3), 1.0, (8, 0, 0)),
    "shifted by 8 along y": (np.eye(3), 1.0, (0, 8, 0)),
    "scaled by 10": (np.eye(3), 10.0, (0, 0, 0)),
    "scaled by 0.1": (np.eye(3), 0.1, (0, 0, 0)),
}


def wrong(
    scene: Scene, cameras: Sequence[Camera], others: Sequence[Camera]
) -> Iterator[tuple[str, Scene, list[Camera]]]:
    """A scene and cameras that are not in its frame, each with what was done; ``others`` are of another scene."""
    for name, motion in MOTIONS.items():
        yield name, moved(scene, *motion), list(cameras)
    yield "cameras with the axes of OpenGL", scene, [looking_back(camera) for camera in cameras]
    yield "another scene's cameras", scene, list(others)


def looking_back(camera: Camera) -> Camera:
    """The camera with its y and z axes turned round, as programs write it that have y up and z back."""
    rotation = np.diag([1.0, -1.0, -1.0]) @ camera.rotation
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ camera.centre)


def _posed(camera: Camera, rotation: F64, centre: F64) -> Camera:
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ centre)


#: What a reader makes of poses that were written in another way than the format says.
MISREADINGS: dict[str, Callable[[Camera], Camera]] = {
    "rotations written world to camera": lambda camera: _posed(camera, camera.rotation.T, camera.centre),
    "poses written world to camera": lambda camera: _posed(camera, camera.rotation.T, camera.translation),
    "translations written as positions": lambda camera: _posed(camera, camera.rotation, camera.translation),
}


def right(scene: Scene, cameras: Sequence[Camera], others: bool = True) -> Iterator[tuple[str, list[Camera]]]:
    """Cameras that are in the scene's frame, each with what they are: some of its own and, if wanted, others."""
    count = len(cameras)
    yield "all cameras", list(cameras)
    yield "every other one", list(cameras[::2])
    beside = np.argsort(camera_centres(cameras)[:, 0], kind="stable")
    yield "those of one side", [cameras[view] for view in beside[: max(count // 2, 1)]]
    yield "four of them", [cameras[view] for view in np.linspace(0, count - 1, 4).astype(int)]
    yield "four others", [cameras[view] for view in np.random.default_rng(1).choice(count, 4, replace=False)]
    for view in np.linspace(0, count - 1, 3).astype(int):
        yield f"number {view} alone", [cameras[view]]
    if not others:
        return
    yield "views from inside", from_inside(scene)
    yield "virtual cameras", place_cameras(scene, 40)


def from_inside(scene: Scene, count: int = 12) -> list[Camera]:
    """Cameras near the middle of a scene that look all around."""
    middle = np.median(scene.means.astype(np.float64), axis=0)
    unit = float(np.median(np.linalg.norm(scene.means - middle, axis=1)))
    rays = np.random.default_rng(2).normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return [looking(middle + 0.3 * unit * ray, middle + unit * ray, name=f"{view}") for view, ray in enumerate(rays)]


def without_directions(scene: Scene) -> Scene:
    """The same scene of SH degree 0: it remembers no directions."""
    return dataclasses.replace(scene, sh=scene.sh[:, :1].copy())


def moved(scene: Scene, axes: F64, scale: float = 1.0, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Scene:
    """The scene after x became ``scale · axes x + shift``, its splats' shapes and colours moved along.

    Args:
        axes: (3, 3) orthogonal; with a determinant of -1 it mirrors.
    """
    axes = np.asarray(axes, np.float64)
    own = rotation_matrices(scene.quaternions.astype(np.float64))
    turned = axes @ own
    # A Gaussian is its own mirror image along each of its axes: one of them makes a rotation of it again.
    turned[..., 2] *= np.sign(np.linalg.det(axes))
    return dataclasses.replace(
        scene,
        means=(scale * scene.means.astype(np.float64) @ axes.T + np.asarray(shift)).astype(np.float32),
        log_scales=scene.log_scales + np.float32(math.log(scale)),
        quaternions=quaternions_of(turned).astype(np.float32),
        sh=rotated_sh(scene.sh, axes),
    )
