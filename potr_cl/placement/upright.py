"""Which way is up (:func:`guess_up`), which no scene file says, and views that are held level."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, camera_centres, focus
from potr_cl.model.scene import Scene

F64 = NDArray[np.float64]

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
#: Splats that are looked at to find surfaces, and the opacity from which they count.
_SAMPLE, _OPAQUE = 20000, 0.1


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
    rotation = level_rotation(camera.rotation[2], up)
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ camera.centre)


def level_rotation(forward: F64, up: F64) -> F64:
    """(3, 3) of a camera that looks along ``forward``, with ``up`` upwards in its picture."""
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
