"""Scenes made of surfaces, whose inside and outside are known."""

from __future__ import annotations

import numpy as np

from potr_cl.model.scene import Scene


def flat_splats(points, normals, size, opacity_logit=4.0, sh=None) -> Scene:
    """One disc-shaped splat at each point, its thin axis along the normal."""
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    # The shortest rotation of z to the normal: (1 + n_z, z x n), or half a turn about x.
    quaternions = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    quaternions[np.linalg.norm(quaternions, axis=1) < 1e-6] = (0, 1, 0, 0)
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


def together(*scenes: Scene) -> Scene:
    """Several scenes of one degree as one."""
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    return Scene(*(np.concatenate([getattr(scene, name) for scene in scenes]) for name in names))


def sphere(splats: int, radius: float, size: float, seed: int = 0, centre=(0.0, 0.0, 0.0)) -> Scene:
    """A sphere's surface."""
    normals = np.random.default_rng(seed).normal(size=(splats, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return flat_splats(radius * normals + centre, normals, size)


def box(splats: int, half, size: float, seed: int = 0) -> Scene:
    """A box's six sides, evenly covered: an object from without, a room from within."""
    half = np.asarray(half, np.float64)
    rng = np.random.default_rng(seed)
    areas = np.repeat([half[1] * half[2], half[0] * half[2], half[0] * half[1]], 2)
    side = rng.choice(6, splats, p=areas / areas.sum())
    points = rng.uniform(-1, 1, (splats, 3)) * half
    normals = np.zeros((splats, 3))
    rows = np.arange(splats)
    normals[rows, side // 2] = np.where(side % 2, 1.0, -1.0)
    points[rows, side // 2] = half[side // 2] * normals[rows, side // 2]
    return flat_splats(points, normals, size)
