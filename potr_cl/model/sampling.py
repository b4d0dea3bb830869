"""Points spread evenly in a cube, on a sphere and on a scene's surfaces, the same ones every time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def low_discrepancy(count: int, dimensions: int) -> F64:
    """(count, dimensions) evenly spread in the unit cube: the additive recurrence on the generalised golden ratio.

    M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
    """
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, dimensions + 1))) % 1


def spiral(count: int) -> F64:
    """(count, 3) unit vectors, evenly spread: Fibonacci's spiral."""
    step = np.arange(count) + 0.5
    return on_sphere(np.stack([1 - step / count, (1 + np.sqrt(5)) / 2 * step], axis=1))


def on_sphere(square: F64) -> F64:
    """(n, 2) in the unit square to (n, 3) unit vectors, areas kept."""
    z = 2 * square[:, 0] - 1
    turn = 2 * np.pi * square[:, 1]
    side = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)


def points_on_splats(means: F64, scales: F64, quaternions: F64, opacities: F64, local: F64) -> tuple[F64, F64]:
    """Points on splats, half of them by number and half by area: a wall may be a few large splats, a small thing
    thousands.

    Args:
        means: (N, 3) centres.
        scales: (N, 3) standard deviations.
        quaternions: (N, 4) w first, of any length.
        opacities: (N,).
        local: (P, 3) where on its splat each point lies, in standard deviations along the splat's axes.

    Returns:
        (P, 3) points, and (P,) the opacity-weighted area that each stands for.
    """
    count = len(local)
    area = opacity_weighted(scales, opacities)
    capped = np.minimum(area, 1000 * area.mean())
    odds = capped / max(float(capped.sum()), 1e-300) + 1 / len(area)
    sums = np.cumsum(odds)
    rows = np.searchsorted(sums, (np.arange(count) + 0.5) / count * sums[-1]).clip(0, len(means) - 1)
    areas = area[rows] * sums[-1] / (odds[rows] * count)
    return means[rows] + turned(local * scales[rows], quaternions[rows]), areas


def opacity_weighted(scales: F64, opacities: F64) -> F64:
    """(N,) area of each splat's largest cross-section, its whole bell, times its opacity."""
    a, b, c = scales.T
    low, high = np.minimum(a, b), np.maximum(a, b)
    area: F64 = 2 * np.pi * (np.maximum(low, np.minimum(high, c)) * np.maximum(high, c)) * opacities
    return area


def turned(offsets: F64, quaternions: F64) -> F64:
    """(P, 3) offsets along splats' own axes, in the world; quaternions (P, 4), w first, of any length."""
    q = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-30)
    across = 2 * np.cross(q[:, 1:], offsets)
    found: F64 = offsets + q[:, :1] * across + np.cross(q[:, 1:], across)
    return found
