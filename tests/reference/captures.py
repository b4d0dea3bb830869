"""Scenes as captures make them, with their cameras (:data:`CAPTURES`): rooms, streets, wide land with a far sky.

They stand for real scenes of kinds that are not at hand. Their colours remember their cameras, as trained ones do.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import ac_basis
from tests.reference.surfaces import facing, points_on_box, together

F64 = NDArray[np.float64]
Capture = tuple[Scene, list[Camera]]


def looking(position: F64, at: F64, up: Sequence[float] = (0.0, 0.0, 1.0), name: str = "", wide: float = 0.7) -> Camera:
    """A camera at a position (3,) that looks at a point (3,); ``wide`` is the tangent of half its field of view."""
    forward = np.asarray(at, np.float64) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = 300 / wide
    return Camera(name, 600, 400, focal, focal, 300, 200, rotation, -rotation @ np.asarray(position, np.float64))


def remembering(scene: Scene, cameras: Sequence[Camera], seed: int = 0) -> Scene:
    """The scene with colours of degree 3 that vary towards the cameras that look at each splat, as trained ones do."""
    rng = np.random.default_rng(seed)
    means = scene.means.astype(np.float64)
    sh = np.zeros((len(scene), 16, 3))
    sh[:, 0] = rng.uniform(-1, 1, (len(scene), 3))
    for camera in cameras:
        x, y, depth = camera.rotation @ means.T + camera.translation[:, None]
        ahead = depth > 0.2
        over = 1 / np.where(ahead, depth, 1)
        inside = ahead & (np.abs(x * over * camera.fx) < camera.width / 2)
        inside &= np.abs(y * over * camera.fy) < camera.height / 2
        seen = np.flatnonzero(inside)
        towards = means[seen] - camera.centre
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        gradient = rng.normal(size=(len(seen), 1, 3)) * 0.02
        sh[seen, 1:] += ac_basis(towards)[:, :, None] * gradient
    return dataclasses.replace(scene, sh=sh.astype(np.float32))


def room() -> Capture:
    """A room of 8 x 5 x 3 from within, furniture in it; the cameras stand inside and look all around."""
    rng = np.random.default_rng(1)
    walls = _box(rng, 14000, (4, 2.5, 1.5), 0.05)
    things = [_box(rng, 1500, (0.5, 0.4, 0.4), 0.03, (x, y, -1.1)) for x, y in ((-3, 1.8), (2.5, -1.6), (0.5, 1.9))]
    spots = rng.uniform(-1, 1, (60, 3)) * (2.5, 1.2, 0.4)
    aims = rng.normal(size=(60, 3)) * (1, 1, 0.3)
    return _capture(together(walls, *things), [(spot, spot + aim) for spot, aim in zip(spots, aims, strict=True)])


def building() -> Capture:
    """Twelve rooms in a row, of which each view sees one."""
    rng = np.random.default_rng(2)
    rooms = [_box(rng, 4000, (2.4, 2.4, 1.5), 0.06, (5 * number, 0, 0)) for number in range(12)]
    spots = np.array([(5 * (number % 12), 0, 0) + rng.uniform(-1, 1, 3) * (1.2, 1.2, 0.4) for number in range(120)])
    aims = rng.normal(size=(120, 3)) * (1, 1, 0.2)
    return _capture(together(*rooms), [(spot, spot + aim) for spot, aim in zip(spots, aims, strict=True)])


def street() -> Capture:
    """A street of 120 between two rows of houses under a far sky; the cameras go along it and look ahead."""
    rng = np.random.default_rng(3)
    houses = [
        _box(rng, 1500, (3.5, 3, rng.uniform(3, 6)), 0.12, (8 * number - 60, side * 9, 3))
        for number in range(16)
        for side in (-1, 1)
    ]
    ground = _sheet(rng, 12000, (64, 6), 0.15)
    places = np.linspace(-58, 50, 90)
    rays = np.stack([np.ones(90), rng.normal(size=90) * 0.7, rng.normal(size=90) * 0.1], axis=1)
    spots = np.stack([places, rng.uniform(-2, 2, 90), np.full(90, 1.7)], axis=1)
    views = [(spot, spot + ray) for spot, ray in zip(spots, rays, strict=True)]
    return _capture(together(*houses, ground, _sky(rng, 6000, 400)), views)


def garden() -> Capture:
    """A thing on a lawn, wide land and a far sky behind it; the cameras go round it."""
    rng = np.random.default_rng(4)
    thing = _box(rng, 9000, (0.6, 0.4, 0.7), 0.02, (0, 0, 0.7))
    lawn = _sheet(rng, 9000, (6, 6), 0.05)
    land = _sheet(rng, 7000, (80, 80), 0.6)
    trees = [
        _box(rng, 500, (1, 1, 2.5), 0.25, (18 * math.cos(turn), 18 * math.sin(turn), 2.5))
        for turn in np.linspace(0, 2 * math.pi, 14, endpoint=False)
    ]
    turns = np.linspace(0, 6 * math.pi, 90, endpoint=False)
    heights = np.repeat([0.8, 1.6, 2.4], 30)
    spots = np.stack([3 * np.cos(turns), 3 * np.sin(turns), heights], axis=1)
    return _capture(
        together(thing, lawn, land, *trees, _sky(rng, 6000, 300)),
        [(spot, np.array([0, 0, 0.6]) + 0.3 * rng.normal(size=3)) for spot in spots],
    )


def terrain() -> Capture:
    """Land of 200 x 200 from the air, in a grid of views that look down."""
    rng = np.random.default_rng(5)
    land = _sheet(rng, 30000, (100, 100), 0.7)
    houses = [_box(rng, 150, (3, 3, 3), 0.4, (*rng.uniform(-90, 90, 2), 2)) for _ in range(60)]
    spots = [np.array([x, y, 45.0]) for x in np.linspace(-90, 90, 9) for y in np.linspace(-90, 90, 9)]
    views = [(spot, spot + np.append(0.25 * rng.normal(size=2), -1)) for spot in spots]
    return _capture(together(land, *houses), views)


def facade() -> Capture:
    """One side of a house, seen from across the road: no view sees anything else."""
    rng = np.random.default_rng(6)
    front = _box(rng, 16000, (6, 0.3, 4), 0.06, (0, 0, 4))
    road = _sheet(rng, 5000, (10, 8), 0.1)
    spots = np.stack([rng.uniform(-7, 7, 40), rng.uniform(-9, -6, 40), rng.uniform(1, 3, 40)], axis=1)
    views = [(spot, np.array([rng.uniform(-4, 4), 0, rng.uniform(1, 6)])) for spot in spots]
    return _capture(together(front, road), views)


#: All of them by name.
CAPTURES: dict[str, Callable[[], Capture]] = {
    "room": room,
    "building": building,
    "street": street,
    "garden": garden,
    "terrain": terrain,
    "facade": facade,
}


def _capture(scene: Scene, views: Sequence[tuple[F64, F64]]) -> Capture:
    cameras = [looking(spot, aim, name=f"{number:03d}") for number, (spot, aim) in enumerate(views)]
    return remembering(scene, cameras), cameras


def _discs(points: F64, normals: F64, size: float, rng: np.random.Generator) -> Scene:
    """Flat opaque splats of about one size."""
    quaternions = facing(normals)
    scales = size * np.exp(0.4 * rng.normal(size=(len(points), 3))) * (1, 1, 0.1)
    sh = np.zeros((len(points), 1, 3), np.float32)
    logits = rng.normal(2.5, 1.5, len(points)).astype(np.float32)
    return Scene(
        points.astype(np.float32), np.log(scales).astype(np.float32), quaternions.astype(np.float32), logits, sh
    )


def _box(
    rng: np.random.Generator, splats: int, half: Sequence[float], size: float, centre: Sequence[float] = (0, 0, 0)
) -> Scene:
    points, normals = points_on_box(rng, splats, half)
    return _discs(points + np.asarray(centre), normals, size, rng)


def _sheet(rng: np.random.Generator, splats: int, half: Sequence[float], size: float) -> Scene:
    points = np.zeros((splats, 3))
    points[:, :2] = rng.uniform(-1, 1, (splats, 2)) * np.asarray(half)
    points[:, 2] = 0.1 * np.sin(points[:, 0]) * np.cos(1.3 * points[:, 1])
    return _discs(points, np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape), size, rng)


def _sky(rng: np.random.Generator, splats: int, radius: float) -> Scene:
    """The upper half of a far sphere, of large splats."""
    towards = rng.normal(size=(splats, 3))
    towards[:, 2] = np.abs(towards[:, 2])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return _discs(radius * rng.uniform(0.7, 1.3, (splats, 1)) * towards, -towards, radius * 0.02, rng)
