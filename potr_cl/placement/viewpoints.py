"""Views for people to look at a scene from, where no cameras are given: :func:`look_around` and :func:`turntable`.

Both stand where :mod:`potr_cl.placement.virtual` finds that somebody could stand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera, camera_centres, focus
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.placement.upright import level_rotation
from potr_cl.placement.virtual import Ground, judging_views

F64 = NDArray[np.float64]

#: Views that :func:`look_around` places and pixels along a side of each picture, unless told otherwise.
VIEWS, SIZE = 8, 800
#: The most that may be asked for.
MOST_VIEWS, LARGEST = 4000, 16384
#: Views that tell where the turntable may run, and the opacity from which a splat should be in its pictures.
_STANDPOINTS, _OPAQUE = 32, 0.1
#: Half the field of view of the turntable's pictures; how high it runs above what it turns around; the part of the
#: opaque splats that its pictures should hold; how much farther away it may stand for that.
_HALF_VIEW, _LOWEST, _HIGHEST = math.radians(25), math.radians(10), math.radians(35)
_HELD, _FARTHER, _WIDEST = 0.9, 1.3, 0.9


def look_around(
    scene: Scene,
    count: int | None = VIEWS,
    size: int | None = SIZE,
    up: Sequence[float] | None = None,
    device: Device | None = None,
) -> list[Camera]:
    """Virtual views from wherever somebody could stand: those by which encodes without cameras are judged.

    Args:
        scene: clean, at least one splat.
        count: of the views; None: as many as such encodes are judged by.
        size: of their square images, in pixels; None: as such encodes have them.
        up: (3,) the direction in the scene that is up in the pictures; None: a guess.
        device: finds what is seen from where; by default the one that should be fastest.

    Returns:
        Cameras "virtual_test_000" and so on, all of them test views: nothing is trained with them.

    Raises:
        UsageError: ``count``, ``size`` or ``up`` is out of range.
    """
    _check(VIEWS if count is None else count, SIZE if size is None else size)
    return judging_views(scene, count, size, device, None if up is None else _direction(up))


def turntable(
    scene: Scene, count: int, size: int = SIZE, up: Sequence[float] | None = None, device: Device | None = None
) -> list[Camera]:
    """Views from a circle around the middle of a scene, evenly spaced, as if the scene stood on a turntable.

    The circle is level, and as far away as the scene was looked at from, as well as its splats remember it.

    Args:
        scene: clean, at least one splat.
        count: of the views.
        size: of their square images, in pixels.
        up: (3,) the axis of the circle; None: a guess.
        device: as of :func:`look_around`.

    Returns:
        Cameras "turntable_000" and so on, all of them test views.

    Raises:
        UsageError: ``count``, ``size`` or ``up`` is out of range.
    """
    _check(count, size)
    wanted = None if up is None else _direction(up)
    ground = Ground.of(scene, _STANDPOINTS, device=device)
    standpoints, top = ground.training(), ground.up if wanted is None else wanted
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
        rotation = level_rotation(-outward, top)
        focal = size / 2 / half
        camera = Camera(
            f"turntable_{number:03d}", size, size, focal, focal, size / 2, size / 2,
            rotation, -rotation @ (middle + radius * outward), "test",
        )  # fmt: skip
        cameras.append(camera)
    return cameras


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
