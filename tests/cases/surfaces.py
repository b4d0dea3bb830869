"""Scenes made of surfaces, whose inside and outside are known."""

from __future__ import annotations

import numpy as np

from potr_cl.model.scene import Scene
from tests.reference.surfaces import facing, points_on_box


def flat_splats(points, normals, size, opacity_logit=4.0, sh=None) -> Scene:
    """One disc-shaped splat at each point, its thin axis along the normal."""
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    quaternions = facing(normals)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    scales = np.full((len(points), 3), float(size))
    scales[:, 2] *= 0.05
    if sh is None:
        sh = np.zeros((len(points), 1, 3))
    return Scene(
        points.astype(np.float32),
        np.log(scales).astype(np.float32),
        quaternions.astype(np.float32),
        np.full(len(points), opacity_logit, np.float32),
        np.asarray(sh, np.float32),
    )


def sphere(splats: int, radius: float, size: float, seed: int = 0, centre=(0.0, 0.0, 0.0)) -> Scene:
    """A sphere's surface."""
    normals = np.random.default_rng(seed).normal(size=(splats, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return flat_splats(radius * normals + centre, normals, size)


def box(splats: int, half, size: float, seed: int = 0) -> Scene:
    """A box's six sides, evenly covered: an object from without, a room from within."""
    points, normals = points_on_box(np.random.default_rng(seed), splats, half)
    return flat_splats(points, normals, size)
