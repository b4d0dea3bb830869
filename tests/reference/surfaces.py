"""Scenes made of surfaces: which way flat splats face, points on a box, several scenes as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import Scene

F64 = NDArray[np.float64]


def facing(normals: F64) -> F64:
    """(n, 4) quaternions, w first and not of unit length, that turn z to unit vectors (n, 3)."""
    # The shortest rotation: (1 + n_z, z x n), or half a turn about x.
    quaternions = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    quaternions[np.linalg.norm(quaternions, axis=1) < 1e-6] = (0, 1, 0, 0)
    return quaternions


def points_on_box(rng: np.random.Generator, count: int, half: Sequence[float] | F64) -> tuple[F64, F64]:
    """(count, 3) points that cover a box's six sides evenly, and their normals: an object from without, a room from
    within.

    Args:
        half: of the box's lengths along x, y and z.
    """
    half = np.asarray(half, np.float64)
    areas = np.repeat([half[1] * half[2], half[0] * half[2], half[0] * half[1]], 2)
    side = rng.choice(6, count, p=areas / areas.sum())
    points = rng.uniform(-1, 1, (count, 3)) * half
    normals = np.zeros((count, 3))
    rows = np.arange(count)
    normals[rows, side // 2] = np.where(side % 2, 1.0, -1.0)
    points[rows, side // 2] = half[side // 2] * normals[rows, side // 2]
    return points, normals


def together(*scenes: Scene) -> Scene:
    """Several scenes of one degree as one."""
    return Scene(
        np.concatenate([scene.means for scene in scenes]),
        np.concatenate([scene.log_scales for scene in scenes]),
        np.concatenate([scene.quaternions for scene in scenes]),
        np.concatenate([scene.opacity_logits for scene in scenes]),
        np.concatenate([scene.sh for scene in scenes]),
    )
