"""Where a scene is, how large, and what hides what from a place: points in a coarse cube map, no rendering."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.sampling import F64, low_discrepancy, points_on_splats
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import unit_coefficients

F32 = NDArray[np.float32]

#: A place is in dense matter if more than this part of all directions is taken up within this (in median radii).
CROWDED, _ELBOW_ROOM = 0.005, 0.2
#: The renderer's near plane in world units, with room to spare: nothing nearer than this is ever seen.
_NEAR = 0.25
#: Splats that the views are judged by, and points that hide them.
_TARGETS = 3000
_OCCLUDERS = 20000
#: Nothing is farther away than this, in median radii.
_FAR = 1e6
#: Cells along a side of the cube map.
_CELLS = 24
#: A splat's opacity above which it counts as matter.
_OPAQUE = 0.1
#: Distance, in median radii, up to which a splat of median size shows all its detail.
_REACH = 2.5


@dataclass(frozen=True)
class Frame:
    """Where the scene is and how large: everything below happens in units of ``unit`` around ``centre``.

    Attributes:
        centre: (3,) weighted median of the opaque splats' centres.
        unit: their median distance from it, in world units.
        up: (3,) unit vector across which they spread least.
        near: the renderer's near plane.
    """

    centre: F64
    unit: float
    up: F64
    near: float


@dataclass(frozen=True)
class Matter:
    """What there is to see, in the frame's units.

    Attributes:
        targets: (K, 3) centres of splats that the views are judged by.
        reach: (K,) distance up to which each shows all its detail.
        colours: (K, M - 1, 3) their AC coefficients, of unit norm; zero if there are none to speak of.
        occluders: (3, P) points on all opaque splats.
        areas: (P,) of the surface that each point stands for; 0 if it is too wide to be in the way.
    """

    targets: F64
    reach: F64
    colours: F32
    occluders: F32
    areas: F32


def frame_of(scene: Scene, run: Run = map) -> Frame:
    """Medians, which neither floaters nor a far shell move.

    Args:
        scene: at least one splat.
        run: in place of :func:`map`, to work with several threads.
    """
    means = scene.means.astype(np.float64)
    weights = np.where(scene.opacities > _OPAQUE, scene.opacities, 1e-6).astype(np.float64)
    centre = np.array(list(run(lambda axis: _weighted_quantile(axis, weights, 0.5), means.T)))
    offsets = means - centre
    distance = np.linalg.norm(offsets, axis=1)
    unit = _weighted_quantile(distance, weights, 0.5)
    # Where splats coincide, their own size is all the size there is.
    sizes = np.exp(np.clip(scene.log_scales.max(axis=1).astype(np.float64), -60, 60))
    unit = max(unit, 2 * _weighted_quantile(sizes, weights, 0.5) if unit < 1e-6 * (1 + np.abs(centre).max()) else 0)
    unit = float(np.clip(unit, max(1e-6 * np.abs(centre).max(), 1e-9), 1e12))
    inner = distance <= 2 * unit
    spread = (offsets[inner] * weights[inner, None]).T @ offsets[inner]
    up = np.linalg.eigh(spread / max(np.abs(spread).max(), 1e-300))[1][:, 0]
    return Frame(centre, unit, up * np.sign(up[np.argmax(np.abs(up))]), _NEAR / unit)


def matter_of(scene: Scene, frame: Frame, targets: int = _TARGETS, occluders: int = _OCCLUDERS) -> Matter:
    """What there is to see of a scene: so many splats to judge by, and points on all that hide them."""
    opacity = scene.opacities.astype(np.float64)
    solid = np.flatnonzero(opacity > _OPAQUE)
    if len(solid) == 0:
        solid = np.arange(len(scene))
    means = np.clip((scene.means[solid].astype(np.float64) - frame.centre) / frame.unit, -_FAR, _FAR)
    scales = np.exp(np.clip(scene.log_scales[solid].astype(np.float64) - math.log(frame.unit), -30, 3))

    chosen = np.unique(np.linspace(0, len(solid) - 1, targets).astype(np.int64))
    largest = scales[chosen].max(axis=1)
    relative = np.sqrt(largest / max(float(np.median(largest)), 1e-12))
    points, areas = points_on_splats(
        means,
        scales,
        scene.quaternions[solid].astype(np.float64),
        opacity[solid],
        2 * low_discrepancy(occluders, 3) - 1,
    )
    # Haze and backdrops: of so wide a splat it means nothing that one of its few points is near.
    areas[areas > _ELBOW_ROOM**2] = 0
    return Matter(
        means[chosen],
        _REACH * relative.clip(0.5, 4),
        unit_coefficients(scene.sh[solid[chosen], 1:]).astype(np.float32),
        points.T.astype(np.float32),
        areas.astype(np.float32),
    )


def surroundings_of(places: F64, matter: Matter) -> tuple[F32, list[float]]:
    """What is around some places, (V, 3).

    Returns:
        (V, cells) distance of the nearest point in each cell of the cube map, infinite where there is none; and of each
        place the part of all directions that matter within arm's length takes up.
    """
    rays = matter.occluders[:, None] - places.T.astype(np.float32)[:, :, None]
    x, y, z = rays
    squared = x * x
    squared += y * y
    squared += z * z
    cells = 6 * _CELLS * _CELLS
    horizons = np.full((len(places), cells), np.inf, np.float32)
    at = cell_of(rays) + np.arange(0, horizons.size, cells)[:, None]
    np.minimum.at(horizons.reshape(-1), at.reshape(-1), np.sqrt(squared).reshape(-1))
    blocked = []
    for row in squared:
        near = row < _ELBOW_ROOM**2
        parts = np.minimum(matter.areas[near] / np.maximum(4 * np.pi * row[near], 1e-30), 1)
        blocked.append(float(parts.sum(dtype=np.float64)))
    return horizons, blocked


def cell_of(rays: F32) -> NDArray[np.int64]:
    """Number of the cube map's cell in each direction, (3, …), of any length but 0."""
    x, y, z = rays
    sizes = np.abs(rays)
    largest = np.maximum(np.maximum(sizes[0], sizes[1]), sizes[2])
    along_x = sizes[0] == largest
    along_z = ~(along_x | (sizes[1] == largest))
    scale = np.float32(_CELLS / 2) / np.maximum(largest, np.float32(1e-30))
    u, v = (
        np.minimum((side * scale + np.float32(_CELLS / 2)).astype(np.int32), _CELLS - 1)
        for side in (np.where(along_x, y, x), np.where(along_z, y, z))
    )
    face = np.where(along_x, x > 0, np.where(along_z, z > 0, y > 0) + np.where(along_z, np.int32(4), np.int32(2)))
    cells: NDArray[np.int64] = ((face * _CELLS + u) * _CELLS + v).astype(np.int64)
    return cells


def _weighted_quantile(values: F64, weights: F64, part: float) -> float:
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, part * sums[-1])), len(order) - 1)]])
