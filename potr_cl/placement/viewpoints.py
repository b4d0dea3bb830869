"""Views for people to look at a scene from, where no cameras are given: :func:`look_around` and :func:`turntable`.

Both stand where :mod:`potr_cl.placement.virtual` finds that somebody could stand; here a few of such views are held
level, or replaced by a circle around what they look at. Which way is up no scene file says:
:func:`guess_up`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera, camera_centres, focus
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.placement.virtual import judging_views, place_cameras

F64 = NDArray[np.float64]

#: Views that :func:`look_around` places and pixels along a side of each picture, unless told otherwise.
VIEWS, SIZE = 8, 800
#: The most that may be asked for.
MOST_VIEWS, LARGEST = 4000, 16384
#: The directions that may be called up, by the names that people type.
AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}
#: How often each is up in the files of the usual tools: COLMAP's cameras have y downwards, Blender and nerfstudio z
#: upwards, glTF and game engines y upwards.
_HABIT = {"-y": 0.3, "z": 0.3, "y": 0.1}
#: What flat ground counts against where the views are, and when its own direction is taken instead of an axis: by how
#: much more of all surface must face it than any direction across it, and the cosines of 10 and 35 degrees to the axis.
_GROUND, _PLAIN, _ALIGNED, _TILTED = 1.5, 0.05, 0.985, 0.82
#: Views that tell where a scene was looked at from.
_STANDPOINTS = 32
#: Splats that are looked at to find surfaces, and the opacity from which they count.
_SAMPLE, _OPAQUE = 20000, 0.1
#: Half the field of view of the turntable's pictures; how high it runs above what it turns around; the part of the
#: opaque splats that its pictures should hold; how much farther away it may stand for that.
_HALF_VIEW, _LOWEST, _HIGHEST = math.radians(25), math.radians(10), math.radians(35)
_HELD, _FARTHER, _WIDEST = 0.9, 1.3, 0.9


def look_around(
    scene: Scene, count: int = VIEWS, size: int = SIZE, up: Sequence[float] | None = None, device: Device | None = None
) -> list[Camera]:
    """Virtual views from wherever somebody could stand, held level: those by which encodes without cameras are judged.

    Args:
        scene: clean, at least one splat.
        count: of the views.
        size: of their square images, in pixels.
        up: (3,) the direction in the scene that is up in the pictures; None: :func:`guess_up`.
        device: finds what is seen from where; by default the one that should be fastest.

    Returns:
        Cameras "virtual_000" and so on, all of them test views: nothing is trained with them.

    Raises:
        UsageError: ``count``, ``size`` or ``up`` is out of range.
    """
    _check(count, size)
    wanted = None if up is None else _direction(up)
    standpoints = judging_views(scene, max(count, _STANDPOINTS), size, device)
    top = guess_up(scene, standpoints) if wanted is None else wanted
    return [dataclasses.replace(levelled(camera, top), split="test") for camera in standpoints[:count]]


def turntable(
    scene: Scene, count: int, size: int = SIZE, up: Sequence[float] | None = None, device: Device | None = None
) -> list[Camera]:
    """Views from a circle around the middle of a scene, evenly spaced, as if the scene stood on a turntable.

    The circle is level, and as far away as the scene was looked at from, as well as its splats remember it.

    Args:
        scene: clean, at least one splat.
        count: of the views.
        size: of their square images, in pixels.
        up: (3,) the axis of the circle; None: :func:`guess_up`.
        device: as of :func:`look_around`.

    Returns:
        Cameras "turntable_000" and so on, all of them test views.

    Raises:
        UsageError: ``count``, ``size`` or ``up`` is out of range.
    """
    _check(count, size)
    wanted = None if up is None else _direction(up)
    standpoints = place_cameras(scene, _STANDPOINTS, size, device=device)
    top = guess_up(scene, standpoints) if wanted is None else wanted
    middle = focus(standpoints)
    away = camera_centres(standpoints) - middle
    distance = np.linalg.norm(away, axis=1)
    usual = float(np.median(distance))
    elevation = float(np.median(np.arcsin(np.clip(away @ top / np.maximum(distance, 1e-300), -1, 1))))
    elevation = min(max(elevation, _LOWEST), _HIGHEST)
    solid = scene.means[scene.opacities > _OPAQUE] if (scene.opacities > _OPAQUE).any() else scene.means
    held = float(np.quantile(np.linalg.norm(solid.astype(np.float64) - middle, axis=1), _HELD))
    radius = min(max(held / math.sin(_HALF_VIEW), usual), _FARTHER * usual)
    # Half the field of view: smaller than usual in scenes so small that the near plane would cut them off, which are
    # looked at through a longer lens; but wide enough for what the pictures should hold.
    half = float(np.median([camera.width / 2 / camera.fx for camera in standpoints]))
    half = max(half, min(math.tan(math.asin(min(held / radius, _WIDEST))), math.tan(_HALF_VIEW)))
    first = np.eye(3)[np.abs(top).argmin()]
    first = first - (first @ top) * top
    first /= np.linalg.norm(first)
    second = np.cross(top, first)
    cameras = []
    for number in range(count):
        turn = 2 * math.pi * number / count
        outward = math.cos(elevation) * (math.cos(turn) * first + math.sin(turn) * second) + math.sin(elevation) * top
        rotation = _level_rotation(-outward, top)
        focal = size / 2 / half
        camera = Camera(
            f"turntable_{number:03d}", size, size, focal, focal, size / 2, size / 2,
            rotation, -rotation @ (middle + radius * outward), "test",
        )  # fmt: skip
        cameras.append(camera)
    return cameras


def guess_up(scene: Scene, standpoints: Sequence[Camera]) -> F64:
    """Which direction of a scene is most likely up: (3,) of length 1.

    Three things speak for a direction: that the scene was looked at from there rather than from below, that much of its
    surface faces it (ground, tables, roofs), and that the usual tools call it up. It is one of the six axes, unless a
    large plane shows that the scene stands askew.

    Args:
        scene: clean, at least one splat.
        standpoints: cameras that stand where the scene was looked at from.
    """
    away = camera_centres(standpoints) - focus(standpoints)
    above = (away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)).mean(axis=0)
    surface = _surface_directions(scene)

    def score(name: str) -> float:
        axis = np.array(AXES[name])
        return float(above @ axis + _GROUND * (axis @ surface @ axis - 1 / 3)) + _HABIT.get(name, 0.0)

    best = np.array(AXES[max(AXES, key=score)])
    parts, directions = np.linalg.eigh(surface)
    ground: F64 = directions[:, 2] * (1 if directions[:, 2] @ best >= 0 else -1)
    askew = parts[2] - parts[1] >= _PLAIN and _TILTED <= float(ground @ best) < _ALIGNED
    return ground if askew else best


def levelled(camera: Camera, up: F64) -> Camera:
    """The same view turned around its line of sight, so that ``up``, (3,), is up in its picture."""
    rotation = _level_rotation(camera.rotation[2], up)
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ camera.centre)


def _level_rotation(forward: F64, up: F64) -> F64:
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:  # looks straight up or down: any roll will do
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = right / np.linalg.norm(right)
    rotation: F64 = np.stack([right, np.cross(forward, right), forward])
    return rotation


def _surface_directions(scene: Scene) -> F64:
    """(3, 3) of trace 1: how much of the surface near the middle faces each direction, either way round."""
    solid = np.flatnonzero(scene.opacities > _OPAQUE)
    if len(solid) == 0:
        return np.eye(3) / 3
    rows = solid[np.unique(np.linspace(0, len(solid) - 1, _SAMPLE).astype(np.int64))]
    means = scene.means[rows].astype(np.float64)
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    scales = np.exp(np.clip(scene.log_scales[rows].astype(np.float64), -60, 60))
    order = np.argsort(scales, axis=1)
    q = scene.quaternions[rows].astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30)
    thin = np.eye(3)[order[:, 0]]
    across = 2 * np.cross(q[:, 1:], thin)
    normals = thin + q[:, :1] * across + np.cross(q[:, 1:], across)
    smallest, middle, largest = np.take_along_axis(scales, order, axis=1).T
    area = middle * largest * scene.opacities[rows]
    # A backdrop is one splat's doing, and a ball faces nowhere.
    weight = np.minimum(area, np.quantile(area, 0.99)) * (1 - smallest / middle)
    weight = np.where(distance <= 3 * np.median(distance), weight, 0.0)
    if not weight.sum() > 0:
        return np.eye(3) / 3
    weight /= weight.max()
    together = (normals * weight[:, None]).T @ normals
    directions: F64 = together / np.trace(together)
    return directions


def _direction(up: Sequence[float]) -> F64:
    direction = np.asarray(up, np.float64)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not np.linalg.norm(direction) > 1e-12:
        raise UsageError("the direction that is up must be three finite numbers, not all of them 0")
    unit: F64 = direction / np.linalg.norm(direction)
    return unit


def _check(count: int, size: int) -> None:
    if not 1 <= count <= MOST_VIEWS:
        raise UsageError(f"{count} views to look from: their number must lie between 1 and {MOST_VIEWS}")
    if not 1 <= size <= LARGEST:
        raise UsageError(f"pictures of {size} x {size} pixels: a side must lie between 1 and {LARGEST}")
