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
from potr_cl.native.declarations import CFunctions, address
from potr_cl.native.table import definition

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
        np.ascontiguousarray(means[chosen]),
        _REACH * relative.clip(0.5, 4),
        unit_coefficients(scene.sh[solid[chosen], 1:]).astype(np.float32),
        np.ascontiguousarray(points.T, np.float32),
        areas.astype(np.float32),
    )


@definition
def horizons_of(place: F64, matter: Matter) -> tuple[F32, float]:
    """What is around a place, (3,).

    Returns:
        (cells,) distance of the nearest point in each cell of the cube map, infinite where there is none; and the part
        of all directions that matter within arm's length takes up.
    """
    rays = matter.occluders - place.astype(np.float32)[:, None]
    x, y, z = rays
    squared = x * x + y * y + z * z
    horizons = np.full(6 * _CELLS * _CELLS, np.inf, np.float32)
    np.minimum.at(horizons, _cells_of(rays), np.sqrt(squared))
    reach = np.float32(_ELBOW_ROOM)
    near = np.flatnonzero(squared < reach * reach)
    parts = np.minimum(matter.areas[near] / np.maximum(4 * np.pi * squared[near], 1e-30), 1)
    # One after the other, as C adds.
    return horizons, float(np.cumsum(parts, dtype=np.float64)[-1]) if len(parts) else 0.0


def _horizons_by_c(c: CFunctions, place: F64, matter: Matter) -> tuple[F32, float]:
    horizons, n = np.empty(6 * _CELLS * _CELLS, np.float32), len(matter.areas)
    at = place.astype(np.float32)
    blocked: float = c["potr_horizons"](
        address(matter.occluders, np.float32, 3 * n),
        address(matter.areas, np.float32, n),
        n,
        address(at, np.float32, 3),
        _ELBOW_ROOM,
        _CELLS,
        address(horizons, np.float32, len(horizons), True),
    )
    return horizons, blocked


@definition
def shown_of(camera: F64, horizons: F32, matter: Matter) -> F32:
    """(K,) 1 for each target that a camera sees and nothing around it hides, else 0.

    Args:
        camera: (19,) its centre and the rows of its rotation; fx, fy, cx, cy; width, height; and the nearest depth that
            it sees.
        horizons: around it (:func:`horizons_of`).
        matter: of the scene.
    """
    fx, fy, cx, cy, width, height, near = camera[12:].tolist()
    ways = matter.targets - camera[:3]
    dx, dy, dz = ways.T
    x, y, z = (a * dx + b * dy + c * dz for a, b, c in camera[3:12].reshape(3, 3).tolist())
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v = fx * x / z + cx, fy * y / z + cy
        inside = (z > near) & (u > 0) & (u < width) & (v > 0) & (v < height)
    horizon = np.float32(1.1) * horizons[_cells_of(ways.T.astype(np.float32))] + np.float32(0.02)
    shown: F32 = (inside & (np.sqrt(dx * dx + dy * dy + dz * dz) <= horizon)).astype(np.float32)
    return shown


def _shown_by_c(c: CFunctions, camera: F64, horizons: F32, matter: Matter) -> F32:
    n = len(matter.targets)
    shown = np.empty(n, np.float32)
    c["potr_shown"](
        address(matter.targets, np.float64, 3 * n),
        n,
        address(camera, np.float64, 19),
        _CELLS,
        address(horizons, np.float32, 6 * _CELLS * _CELLS),
        address(shown, np.float32, n, True),
    )
    return shown


def _cells_of(rays: F32) -> NDArray[np.int64]:
    """Number of the cube map's cell in each direction, (3, …), of any finite length but 0."""
    x, y, z = rays
    sizes = np.abs(rays)
    largest = np.maximum(np.maximum(sizes[0], sizes[1]), sizes[2])
    along_x = sizes[0] == largest
    along_z = ~(along_x | (sizes[1] == largest))
    scale = np.float32(_CELLS / 2) / np.maximum(largest, np.float32(1e-30))
    u, v = (
        np.clip((side * scale + np.float32(_CELLS / 2)).astype(np.int32), 0, _CELLS - 1)
        for side in (np.where(along_x, y, x), np.where(along_z, y, z))
    )
    face = np.where(along_x, x > 0, np.where(along_z, z > 0, y > 0) + np.where(along_z, np.int32(4), np.int32(2)))
    cells: NDArray[np.int64] = ((face * _CELLS + u) * _CELLS + v).astype(np.int64)
    return cells


def _weighted_quantile(values: F64, weights: F64, part: float) -> float:
    # In what order equal values come, moves no more than the last digit of a sum.
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, part * sums[-1])), len(order) - 1)]])
