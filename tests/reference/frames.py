"""Cameras that are in a scene's frame and such that are not: what :mod:`potr_cl.model.agreement` is judged by.

:func:`moved` turns, mirrors, scales and shifts a scene as programs that edit scenes do, colours included.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import quaternions_of, rotated_sh
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


def _turn(axis: int, degrees: float) -> F64:
    turn, (i, j) = np.eye(3), [(axis + 1) % 3, (axis + 2) % 3]
    turn[i, i] = turn[j, j] = math.cos(math.radians(degrees))
    turn[j, i] = math.sin(math.radians(degrees))
    turn[i, j] = -turn[j, i]
    return turn


#: What they do by ordinary amounts: photographs and points of a reconstruction find that, and nothing else.
ORDINARY: dict[str, tuple[F64, float, tuple[float, float, float]]] = {
    **{f"scaled by {factor:g}": (np.eye(3), factor, (0, 0, 0)) for factor in (0.5, 0.7, 1.5, 2.0, 5.0)},
    "shifted by 1 along x": (np.eye(3), 1.0, (1, 0, 0)),
    "shifted by 1 along y": (np.eye(3), 1.0, (0, 1, 0)),
    "shifted by 3 along x": (np.eye(3), 1.0, (3, 0, 0)),
    "shifted by 3 along z": (np.eye(3), 1.0, (0, 0, 3)),
    **{
        f"turned by {degrees} degrees about {'xyz'[axis]}": (_turn(axis, degrees), 1.0, (0, 0, 0))
        for axis, degrees in ((2, 10), (0, 10), (1, 20), (2, 30), (0, 45))
    },
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


#: What may have become of photographs whose cameras are right: a function of (H, W, 4) pixels, 0 to 1.
PHOTOGRAPHS: dict[str, Callable[[F64], F64]] = {
    "half as bright": lambda pixels: pixels * (0.5, 0.5, 0.5, 1),
    "overexposed": lambda pixels: np.minimum(pixels * (1.8, 1.8, 1.8, 1), 1),
    "in warmer light": lambda pixels: np.minimum(pixels * (1.3, 1, 0.7, 1), 1),
    "over white": lambda pixels: np.dstack([1 - (1 - pixels[..., :3]) * pixels[..., 3:], pixels[..., 3:] ** 0]),
    "a quarter as large": lambda pixels: pixels[2::4, 2::4],
    "missing but for three": lambda pixels: pixels,
}


def changed(cameras: Sequence[Camera], which: str, folder: Path) -> list[Camera]:
    """Cameras whose photographs are those that :data:`PHOTOGRAPHS` makes of their own, written into a folder."""
    every = max(len(cameras) // 3, 2)
    result = []
    for number, camera in enumerate(cameras):
        path = folder / f"{number}.png"
        if camera.image_path is None or ("three" in which and number % every != 1):
            result.append(dataclasses.replace(camera, image_path=None))
            continue
        with Image.open(camera.image_path) as image:
            pixels = np.asarray(image.convert("RGBA"), np.float64) / 255
        Image.fromarray(np.rint(255 * PHOTOGRAPHS[which](pixels)).astype(np.uint8)).save(path, compress_level=1)
        result.append(dataclasses.replace(camera, image_path=path))
    return result


def parts(scene: Scene, splats: int, count: int) -> list[Scene]:
    """Parts that were cut out of a scene: spheres of so many splats around random ones of it."""
    rng = np.random.default_rng(0)
    distances = (np.linalg.norm(scene.means - scene.means[rng.integers(len(scene))], axis=1) for _ in range(count))
    return [scene.subset(np.sort(np.argsort(each, kind="stable")[:splats])) for each in distances]


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
