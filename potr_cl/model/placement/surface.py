"""Points on the surfaces of a scene (:func:`points_on_splats`), which stand for what hides other things."""

from __future__ import annotations

import numpy as np

from potr_cl.model.placement.sampling import F64


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
    area: F64 = 2 * np.pi * np.sort(scales, axis=1)[:, 1:].prod(axis=1) * opacities
    return area


def turned(offsets: F64, quaternions: F64) -> F64:
    """(P, 3) offsets along splats' own axes, in the world; quaternions (P, 4), w first, of any length."""
    q = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-30)
    across = 2 * np.cross(q[:, 1:], offsets)
    found: F64 = offsets + q[:, :1] * across + np.cross(q[:, 1:], across)
    return found
