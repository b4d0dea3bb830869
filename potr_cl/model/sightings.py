"""What views see of a scene, roughly and quickly: :func:`look`, on a :class:`Sample` of the scene. Pure NumPy.

A few thousand points stand for the scene's surface and hide what is behind them; some splats are looked at in the
pictures. That is enough to tell whether a view looks at the scene at all, from how far, and from where the scene's
colours were trained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.sampling import points_on_splats, spiral
from potr_cl.model.scene import Scene, opacities_of
from potr_cl.model.spherical_harmonics import ac_basis, energy, unit_coefficients
from potr_cl.model.splat_groups import NEAR

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Splats that a scene is thinned to, splats that are looked at, points that hide what is behind them.
_THINNED, _TARGETS, _POINTS = 60_000, 1_500, 6_000
#: A splat's opacity above which it counts as matter.
_OPAQUE = 0.1
#: Splats by which it is made sure that a view shows none, and those that are looked at together.
_MOST, _TOGETHER = 2_000_000, 1 << 17
#: How far beside a picture centres count, at distance 1: their splats reach into it.
_ROOM = 0.1
#: Nothing is farther away than this, in units of the sample.
_FAR = 1e6
#: Cells along a side of a picture: of the map of depths, and of the map of what is covered.
_DEPTHS, _COVERS = 32, 16
#: A cell is wide: what is a little behind its nearest point may be the same surface. In units, and as a part.
_BEHIND, _DEEPER = 0.05, 1.05
#: Directions in which colours are looked at to know how much they vary at all.
_DIRECTIONS = 96
#: Splats for which that is done at a time: few enough that a BLAS does not wake its threads, which take longer to come
#: to rest again than all of the work takes.
_AT_ONCE = 48
#: Splats with coefficients to speak of that a view must see, for the colours to tell whether they know it.
_INFORMATIVE = 30
#: Coefficients a channel but DC, from which on colours tell one side from the other: those of two degrees.
_TELLING = 8


@dataclass(frozen=True)
class Sample:
    """A scene in short, in units of ``unit`` around ``centre``.

    Attributes:
        centre: (3,) world units; median of the opaque splats' centres.
        unit: their median distance from it, in world units.
        targets: (K, 3) centres of some of them, evenly chosen.
        sizes: (K,) their largest standard deviation.
        colours: (K, M - 1, 3) AC coefficients, of unit norm; zero where there are none to speak of.
        overall: (D, K) their energy (:func:`potr_cl.model.spherical_harmonics.energy`) in directions all around.
        informative: (K,) whose colours depend on the direction.
        points: (P, 3) on the scene's surfaces.
        areas: (P,) opacity-weighted area that each stands for.
    """

    centre: F64
    unit: float
    targets: F64
    sizes: F64
    colours: F64
    overall: F64
    informative: Mask
    points: F64
    areas: F64

    @property
    def remembers(self) -> bool:
        """Whether the colours can tell from where they were trained: a degree of 2 or more, and enough of them."""
        return self.colours.shape[1] >= _TELLING and int(self.informative.sum()) >= _INFORMATIVE


@dataclass(frozen=True)
class Poses:
    """Where some cameras stand.

    Attributes:
        centres: (V, 3).
        rotations: (V, 3, 3) world to camera; of determinant -1 in a mirrored frame.
        windows: (V, 4) the pictures' left, right, upper and lower edges, at distance 1.
        near: the near plane.
    """

    centres: F64
    rotations: F64
    windows: F64
    near: float

    def some(self, views: NDArray[np.int64]) -> Poses:
        """Those of some of the cameras, by their numbers."""
        return Poses(self.centres[views], self.rotations[views], self.windows[views], self.near)

    def moved(self, axes: F64, scale: float) -> Poses:
        """The same cameras after the world was moved: x became scale · axes x, axes (3, 3)."""
        with np.errstate(over="ignore", invalid="ignore"):
            centres = scale * self.centres @ axes.T
        return Poses(centres, self.rotations @ axes.T, self.windows, self.near * scale)

    def turned_round(self) -> Poses:
        """The same cameras, each with its own y and z axes turned round: it looks the other way."""
        return Poses(self.centres, np.array([[1.0], [-1.0], [-1.0]]) * self.rotations, self.windows, self.near)

    def transposed(self) -> Poses:
        """The same cameras, where each rotation was written the wrong way round, and its centre right."""
        return Poses(self.centres, self.rotations.transpose(0, 2, 1), self.windows, self.near)

    def inverted(self) -> Poses:
        """The same cameras, where world-to-camera matrices were written for camera-to-world ones."""
        with np.errstate(over="ignore", invalid="ignore"):
            centres = -np.einsum("vij,vj->vi", self.rotations, self.centres)
        return Poses(centres, self.rotations.transpose(0, 2, 1), self.windows, self.near)

    def from_translations(self) -> Poses:
        """The same cameras, where the translations of their world-to-camera poses were written for their centres."""
        with np.errstate(over="ignore", invalid="ignore"):
            centres = -np.einsum("vji,vj->vi", self.rotations, self.centres)
        return Poses(centres, self.rotations, self.windows, self.near)

    def within(self, of: Sample) -> Poses:
        """The same cameras in the units of a sample."""
        with np.errstate(over="ignore", invalid="ignore"):
            centres = np.nan_to_num((self.centres - of.centre) / of.unit)
        return Poses(np.clip(centres, -_FAR, _FAR), self.rotations, self.windows, self.near / of.unit)


@dataclass(frozen=True)
class ViewStatistics:
    """What each of V views sees.

    Attributes:
        seen: (V, K) which targets, not hidden by others.
        covered: (V,) part of the picture that shows matter and not background.
        sizes: (V,) size of a typical seen splat as a part of the picture's; NaN where none is seen.
        remembered: (V,) how strongly the colours of what is seen vary towards the view, as a part of how they vary in
            the best directions; NaN where the colours do not tell.
    """

    seen: Mask
    covered: F64
    sizes: F64
    remembered: F64

    def some(self, views: NDArray[np.int64]) -> ViewStatistics:
        """What some of the views see, by their numbers."""
        return ViewStatistics(self.seen[views], self.covered[views], self.sizes[views], self.remembered[views])


def sample(scene: Scene) -> Sample:
    """A sample of a scene, the same on every call; ``scene``: clean, at least one splat."""
    rows = looked_at(len(scene))
    opaque = rows[opacities_of(scene.opacity_logits[rows]) > _OPAQUE]
    scene = scene.subset(opaque if len(opaque) else rows)
    means = scene.means.astype(np.float64)
    centre = np.median(means, axis=0)
    log_scales = scene.log_scales.astype(np.float64)
    unit = float(np.median(np.linalg.norm(means - centre, axis=1)))
    own = float(np.exp(np.clip(np.median(log_scales.max(axis=1)), -60, 60)))
    # Where splats coincide, their own size is all the size there is.
    unit = float(np.clip(unit if unit > 1e-6 * (1 + np.abs(centre).max()) else 2 * own, 1e-9, 1e12))
    means = np.clip((means - centre) / unit, -_FAR, _FAR)
    scales = np.exp(np.clip(log_scales - math.log(unit), -30, 3))

    chosen = _spread(len(means), _TARGETS)
    colours = unit_coefficients(scene.sh[chosen, 1:])
    around = ac_basis(spiral(_DIRECTIONS))[:, : colours.shape[1]]
    overall = [
        np.matmul(around, some.transpose(1, 0, 2).reshape(around.shape[1], 3 * len(some))).reshape(-1, len(some), 3)
        ** 2
        for some in (colours[first : first + _AT_ONCE] for first in range(0, len(colours), _AT_ONCE))
    ]
    # Within one standard deviation, on the spiral's directions in an order that is not the splats'.
    local = spiral(_POINTS)[(np.arange(_POINTS) * 2741) % _POINTS]
    quaternions, opacities = scene.quaternions.astype(np.float64), scene.opacities.astype(np.float64)
    points, areas = points_on_splats(means, scales, quaternions, opacities, local)
    return Sample(
        centre,
        unit,
        means[chosen],
        scales[chosen].max(axis=1),
        colours,
        np.concatenate(overall, axis=1).sum(axis=2),
        np.asarray(colours.any(axis=(1, 2))),
        points,
        areas,
    )


def _spread(count: int, wanted: int) -> NDArray[np.int64]:
    """Numbers of so many of ``count`` things, or of all, evenly spread and ascending."""
    numbers = np.linspace(0, count - 1, min(count, wanted)).astype(np.int64)
    return numbers[np.diff(numbers, prepend=-1) > 0]


def looked_at(count: int) -> NDArray[np.int64]:
    """Which of so many splats :func:`sample` looks at: of a scene of these alone it makes the same sample."""
    return _spread(count, _THINNED)


def poses(cameras: Sequence[Camera]) -> Poses:
    """Where cameras stand, in world units."""
    windows = [(-c.cx / c.fx, (c.width - c.cx) / c.fx, -c.cy / c.fy, (c.height - c.cy) / c.fy) for c in cameras]
    rotations = np.array([camera.rotation for camera in cameras])
    return Poses(camera_centres(cameras), rotations, np.array(windows), NEAR)


def look(at: Sample, world: Poses) -> ViewStatistics:
    """What views see of a scene.

    Args:
        at: the scene.
        world: of the views, in world units.
    """
    views = world.within(at)
    shape = (len(views.centres), len(at.targets))
    seen, covered = np.zeros(shape, bool), np.zeros(shape[0])
    sizes, remembered = np.full(shape[0], np.nan), np.full(shape[0], np.nan)
    for view, (camera_centre, rotation, window) in enumerate(
        zip(views.centres, views.rotations, views.windows, strict=True)
    ):
        seen[view], depths, covered[view] = _picture(at, camera_centre, rotation, window, views.near)
        now = np.flatnonzero(seen[view])
        if not len(now):
            continue
        extent = math.sqrt(max((window[1] - window[0]) * (window[3] - window[2]), 1e-30))
        sizes[view] = float(np.median(at.sizes[now] / depths[now])) / extent
        now = now[at.informative[now]]
        if at.remembers and len(now) >= _INFORMATIVE:
            rays = at.targets[now] - camera_centre
            own = energy(rays, at.colours[now])
            known = np.bincount(now, minlength=shape[1])
            # Without BLAS, whose threads would go on waiting for more at full speed.
            best = float(np.quantile(np.einsum("dk,k->d", at.overall, known) / len(now), 0.95))
            remembered[view] = float(own.mean()) / max(best, 1e-12)
    return ViewStatistics(seen, covered, sizes, remembered)


def show_nothing(scene: Scene, world: Poses) -> Mask:
    """Which of some views have no splat's centre in their pictures, nor near the edges: (V,).

    A sample may leave out all that a view of a large scene shows; here up to two million splats are looked at.

    Args:
        scene: clean, at least one splat.
        world: of the views, in world units.
    """
    rows = _spread(len(scene), _MOST)
    nothing = np.ones(len(world.centres), bool)
    for first in range(0, len(rows), _TOGETHER):
        means = scene.means[rows[first : first + _TOGETHER]].astype(np.float64)
        for view in np.flatnonzero(nothing):
            with np.errstate(over="ignore", invalid="ignore"):
                x, y, depth = world.rotations[view] @ (means - world.centres[view]).T
            left, right, upper, lower = world.windows[view] + _ROOM * np.array([-1.0, 1, -1, 1])
            shown = (depth > 0) & (x >= left * depth) & (x <= right * depth) & (y >= upper * depth)
            nothing[view] = not (shown & (y <= lower * depth)).any()
    return nothing


def _picture(at: Sample, camera_centre: F64, rotation: F64, window: F64, near: float) -> tuple[Mask, F64, float]:
    """Which targets a view shows, the depths of all, and the part of the picture that is covered."""

    def projected(points: F64) -> tuple[Mask, F64, F64, F64]:
        x, y, depth = rotation @ (points - camera_centre).T
        ahead = depth > near
        over = 1 / np.where(ahead, depth, 1)
        u = (x * over - window[0]) / max(window[1] - window[0], 1e-30)
        v = (y * over - window[2]) / max(window[3] - window[2], 1e-30)
        inside = ahead & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        return inside, depth, u, v

    inside, depth, u, v = projected(at.points)
    shown = np.flatnonzero(inside)
    u, v, depth = u[shown], v[shown], depth[shown]
    nearest = np.full(_DEPTHS * _DEPTHS, np.inf)
    np.minimum.at(nearest, (v * _DEPTHS).astype(np.int64) * _DEPTHS + (u * _DEPTHS).astype(np.int64), depth)
    cells = (v * _COVERS).astype(np.int64) * _COVERS + (u * _COVERS).astype(np.int64)
    extent = max((window[1] - window[0]) * (window[3] - window[2]), 1e-30)
    layers = np.bincount(cells, at.areas[shown] / (depth * depth) * (_COVERS**2 / extent), minlength=_COVERS**2)
    covered = float(-np.expm1(-layers).sum()) / _COVERS**2

    inside, depth, u, v = projected(at.targets)
    shown = np.flatnonzero(inside)
    cell = (v[shown] * _DEPTHS).astype(np.int64) * _DEPTHS + (u[shown] * _DEPTHS).astype(np.int64)
    seen = np.zeros(len(at.targets), bool)
    seen[shown] = depth[shown] <= _DEEPER * nearest[cell] + _BEHIND
    return seen, depth, covered
