"""Virtual cameras for scenes that come with none: where would someone stand who looks at this? Pure numpy.

A trained scene remembers how it was looked at. Splats are where the photographs had detail, empty space is where the
photographer stood, and the SH coefficients of a splat are a sum of basis functions in the directions of the views that
trained it, so its colour varies most in those directions and hardly in others. :func:`place_cameras` draws candidates
all around and inside the scene, rejects those that stand in dense matter or from where the colours were never trained,
and picks, one after the other, the view that adds most: splats seen from directions from which they were not seen yet.

Visibility is that of points in a coarse cube map, not a rendering: no device is needed, and the same scene gives the
same cameras everywhere.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import ac_basis

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

#: Training views that are placed unless told otherwise. Many small ones leave fewer gaps than few large ones of as many
#: pixels; but each costs time and memory for every splat, so that large scenes get fewer.
FEWEST, MOST = 100, 300
_SPLATS_TIMES_VIEWS = 150_000_000
#: Pixels of all of them together, and along a side of each.
_PIXELS = 108_000_000
_SMALLEST, _LARGEST = 500, 1000
#: What may be asked for: no more views than places are tried, no wider ones than are rendered.
_MOST_ASKED, _WIDEST_ASKED = 4000, 16384
#: What the names of virtual cameras begin with.
_PREFIX = "virtual_"

#: Half the field of view: tan of 25 degrees, both ways.
_HALF_VIEW = math.tan(math.radians(25))
#: The renderer's near plane in world units, with room to spare: nothing nearer than this is ever seen.
_NEAR = 0.25
#: Splats that the views are judged by, points that hide them, and places to stand that are tried.
_TARGETS = 3000
_OCCLUDERS = 20000
_PLACES = 800
#: Views that are tried at each place.
_AIMS = 6
#: Distances of the places from the centre, in units of the scene's median radius.
_NEAREST, _FARTHEST = 0.2, 4.0
#: Nothing is farther away than this, in median radii.
_FAR = 1e6
#: Cells along a side of the cube map.
_CELLS = 24
#: A splat's opacity above which it counts as matter.
_OPAQUE = 0.1
#: A place is in dense matter if more than this part of all directions is taken up within this (in median radii).
_CROWDED, _ELBOW_ROOM = 0.005, 0.2
#: Distance, in median radii, up to which a splat of median size shows all its detail.
_REACH = 2.5
#: Directions from which seeing a splat counts as new.
_BINS = 32
#: The SH energy towards a view, as a part of the same splats' highest: below the first it was never trained, above the
#: second it was.
_UNTRAINED, _TRAINED = 0.65, 0.85
#: Part of all directions that is blocked where a place counts as enclosed, and part of the views that must be for the
#: scene to count as having an inside.
_ENCLOSED, _FEW = 0.8, 0.05
#: How far the standpoints around a virtual view are from it, as a part of its distance from the scene.
_AROUND = 0.35
#: Targets with coefficients to speak of, below which that is not asked.
_INFORMATIVE = 100


@dataclass(frozen=True)
class _Frame:
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
class _Matter:
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


@dataclass(frozen=True)
class _Candidates:
    """Views to choose from, in the frame's units.

    Attributes:
        camera centres: (C, 3) positions.
        forward: (C, 3) unit vectors.
        tangent: (C,) tan of half the field of view.
        worth: (C, K) what the view shows of each target, 0 to 1.
        bins: (C, K) from which of the directions.
        enclosed: (C,) whether there is matter nearly all around.
        trained: whether the colours tell how plausible each view is; ``worth`` then holds it already.
    """

    centres: F64
    forward: F64
    tangent: F64
    worth: F32
    bins: NDArray[np.uint8]
    enclosed: NDArray[np.bool_]
    trained: bool


def place_cameras(scene: Scene, count: int | None = None, size: int | None = None) -> list[Camera]:
    """Views that cover what someone would look at.

    Args:
        scene: clean, at least one splat.
        count: training views; by default 100 to 300, the fewer the more splats there are. An eighth as many test views,
            which lie among them, come on top.
        size: of their square images, in pixels; by default 500 to 1000, the smaller the more views there are.

    Returns:
        Cameras "virtual_000" and so on, in the order in which they were picked.

    Raises:
        UsageError: ``count`` or ``size`` below 1, or above what can be placed and rendered.
    """
    if count is None:
        count = min(max(_SPLATS_TIMES_VIEWS // len(scene), FEWEST), MOST)
    if size is None:
        size = min(max(round(math.sqrt(_PIXELS / max(count, 1))), _SMALLEST), _LARGEST)
    if not (1 <= count <= _MOST_ASKED and 1 <= size <= _WIDEST_ASKED):
        raise UsageError(
            f"{count} virtual views of {size} x {size} pixels: both must be at least 1, the views at most "
            f"{_MOST_ASKED}, a side at most {_WIDEST_ASKED}"
        )
    frame = _frame(scene)
    matter = _matter(scene, frame)
    candidates = _candidates(frame, matter)
    tests = count // 8
    picked = _pick(candidates, count + tests)
    every = (count + tests) // tests if tests else 0
    cameras = []
    for number, view in enumerate(picked):
        split = "test" if every and number % every == every - 1 and number // every < tests else "train"
        camera_centre = frame.centre + frame.unit * candidates.centres[view]
        cameras.append(
            _camera(
                f"{_PREFIX}{number:03d}",
                camera_centre,
                candidates.forward[view],
                frame.up,
                candidates.tangent[view],
                size,
                split,
            )
        )
    return cameras


def is_virtual(cameras: Sequence[Camera]) -> bool:
    """Whether they were placed by :func:`place_cameras`, by their names."""
    return bool(cameras) and all(camera.name.startswith(_PREFIX) for camera in cameras)


def standpoints(cameras: Sequence[Camera], means: F32) -> F64:
    """Where to look from when colours are fitted: what the compaction takes as camera centres.

    Someone will look from between virtual views, where a fit to them alone runs wild. So each shares its weight with
    four places around it.

    Args:
        means: (N, 3) centres of the scene.

    Returns:
        (S, 3) the camera centres of given cameras, (S, 4, 3) the places around those of virtual ones.
    """
    centres = camera_centres(cameras)
    if not is_virtual(cameras):
        return centres
    some = means[:: max(len(means) // _TARGETS, 1)].astype(np.float64)
    away = np.array([np.median(np.linalg.norm(some - camera_centre, axis=1)) for camera_centre in centres])
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
    return centres[:, None] + _AROUND * away[:, None, None] * corners


def describe(cameras: Sequence[Camera]) -> str:
    """How many views, and where, in words."""
    centres = camera_centres(cameras)
    across = np.eye(3) - np.stack([np.outer(c.rotation[2], c.rotation[2]) for c in cameras])
    # The point that their lines of sight come nearest to.
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=1e-9)[0]
    distance = np.linalg.norm(centres - focus, axis=1)
    at = ", ".join(f"{x:.3g}" for x in focus)
    train, test = (sum(c.split == split for c in cameras) for split in ("train", "test"))
    judges = f" and {test} to judge by" if test else ""
    return f"{train} virtual views{judges} placed {distance.min():.3g} to {distance.max():.3g} units from ({at})"


def _camera(name: str, camera_centre: F64, forward: F64, up: F64, tangent: float, size: int, split: str) -> Camera:
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:  # looks straight up or down: any roll will do
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = size / 2 / tangent
    return Camera(name, size, size, focal, focal, size / 2, size / 2, rotation, -rotation @ camera_centre, split)


def _weighted_quantile(values: F64, weights: F64, part: float) -> float:
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, part * sums[-1])), len(order) - 1)]])


def _frame(scene: Scene) -> _Frame:
    """Medians, which neither floaters nor a far shell move."""
    means = scene.means.astype(np.float64)
    weights = np.where(scene.opacities > _OPAQUE, scene.opacities, 1e-6).astype(np.float64)
    centre = np.array([_weighted_quantile(means[:, axis], weights, 0.5) for axis in range(3)])
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
    return _Frame(centre, unit, up * np.sign(up[np.argmax(np.abs(up))]), _NEAR / unit)


def _low_discrepancy(count: int, dimensions: int) -> F64:
    """(count, dimensions) evenly spread in the unit cube: the additive recurrence on the generalised golden ratio."""
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, dimensions + 1))) % 1


def _on_sphere(square: F64) -> F64:
    """(n, 2) in the unit square to (n, 3) unit vectors, areas kept."""
    z = 2 * square[:, 0] - 1
    turn = 2 * np.pi * square[:, 1]
    side = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)


_BIN_DIRECTIONS = _on_sphere(_low_discrepancy(_BINS, 2)).astype(np.float32)


def _matter(scene: Scene, frame: _Frame) -> _Matter:
    opacity = scene.opacities.astype(np.float64)
    solid = np.flatnonzero(opacity > _OPAQUE)
    if len(solid) == 0:
        solid = np.arange(len(scene))
    means = np.clip((scene.means[solid].astype(np.float64) - frame.centre) / frame.unit, -_FAR, _FAR)
    scales = np.exp(np.clip(scene.log_scales[solid].astype(np.float64) - math.log(frame.unit), -30, 3))

    chosen = np.unique(np.linspace(0, len(solid) - 1, _TARGETS).astype(np.int64))
    largest = scales[chosen].max(axis=1)
    relative = np.sqrt(largest / max(float(np.median(largest)), 1e-12))
    colours = scene.sh[solid[chosen], 1:].astype(np.float64)
    norm = np.sqrt((colours**2).sum(axis=(1, 2)))
    colours = np.where(norm > 1e-4, 1 / np.maximum(norm, 1e-4), 0)[:, None, None] * colours

    # Half of the points by number, half by area: a wall may be a few large splats, a small thing thousands.
    area = 2 * np.pi * np.sort(scales, axis=1)[:, 1:].prod(axis=1) * opacity[solid]
    capped = np.minimum(area, 1000 * area.mean())
    odds = capped / max(capped.sum(), 1e-300) + 1 / len(area)
    sums = np.cumsum(odds)
    rows = np.searchsorted(sums, (np.arange(_OCCLUDERS) + 0.5) / _OCCLUDERS * sums[-1]).clip(0, len(solid) - 1)
    areas = area[rows] * sums[-1] / (odds[rows] * _OCCLUDERS)
    # Haze and backdrops: of so wide a splat it means nothing that one of its few points is near.
    areas[areas > _ELBOW_ROOM**2] = 0
    q = scene.quaternions[solid[rows]].astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30)
    local = (2 * _low_discrepancy(_OCCLUDERS, 3) - 1) * scales[rows]
    across = 2 * np.cross(q[:, 1:], local)
    points = means[rows] + local + q[:, :1] * across + np.cross(q[:, 1:], across)
    return _Matter(
        means[chosen],
        _REACH * relative.clip(0.5, 4),
        colours.astype(np.float32),
        points.T.astype(np.float32),
        areas.astype(np.float32),
    )


def _cell(rays: F32) -> NDArray[np.int64]:
    """Number of the cube map's cell in each direction, (3, n), of any length but 0."""
    x, y, z = rays
    size_x, size_y, size_z = np.abs(rays)
    along_x = (size_x >= size_y) & (size_x >= size_z)
    along_y = ~along_x & (size_y >= size_z)
    major = np.where(along_x, x, np.where(along_y, y, z))
    scale = np.float32(_CELLS / 2) / np.maximum(np.abs(major), np.float32(1e-30))
    u = np.where(along_x, y, np.where(along_y, z, x)) * scale + np.float32(_CELLS / 2)
    v = np.where(along_x, z, np.where(along_y, x, y)) * scale + np.float32(_CELLS / 2)
    u, v = (np.minimum(c.astype(np.int64), _CELLS - 1) for c in (u, v))
    axis = np.where(along_x, 0, np.where(along_y, 1, 2))
    cells: NDArray[np.int64] = ((2 * axis + (major > 0)) * _CELLS + u) * _CELLS + v
    return cells


def _places(frame: _Frame) -> tuple[F64, F64]:
    """Positions to try, and the tangent of half the field of view there.

    Evenly in direction and in the logarithm of the distance. Where the near plane would cut off a small scene, the
    camera steps back and looks through a longer lens.
    """
    spread = _low_discrepancy(_PLACES, 3)
    distance = _NEAREST * (_FARTHEST / _NEAREST) ** spread[:, 2]
    away = np.maximum(distance, frame.near + 1.5) if frame.near > 0.5 else distance
    return _on_sphere(spread[:, :2]) * away[:, None], _HALF_VIEW * distance / away


def _surroundings(camera_centre: F64, matter: _Matter) -> tuple[F32, float]:
    """What is around ``camera centre``.

    Returns:
        Distance of the nearest point in each cell of the cube map, infinite where there is none; and the part of all
        directions that matter within arm's length takes up.
    """
    rays = matter.occluders - camera_centre.astype(np.float32)[:, None]
    squared = np.einsum("ij,ij->j", rays, rays)
    horizon = np.full(6 * _CELLS * _CELLS, np.inf, np.float32)
    np.minimum.at(horizon, _cell(rays), np.sqrt(squared))
    near = squared < _ELBOW_ROOM**2
    blocked = np.minimum(matter.areas[near] / np.maximum(4 * np.pi * squared[near], 1e-30), 1)
    return horizon, float(blocked.sum(dtype=np.float64))


def _candidates(frame: _Frame, matter: _Matter) -> _Candidates:
    """All views from all places that are free; from the freest tenth if too few are."""
    places, tangents = _places(frame)
    horizons, blocked = zip(*[_surroundings(camera_centre, matter) for camera_centre in places], strict=True)
    crowd = np.array(blocked)
    free = np.flatnonzero(crowd <= max(_CROWDED, float(np.quantile(crowd, 0.1))))
    views = [_views_from(places[place], tangents[place], horizons[place], frame, matter) for place in free]
    worths = [worth for _, worth, _ in views]
    remembered = _remembered(places[free], [np.maximum.reduce(worth) for worth in worths], matter)
    if remembered is not None:
        plausible = np.clip((remembered - _UNTRAINED) / (_TRAINED - _UNTRAINED), 0, 1)
        worths = [worth * part for worth, part in zip(worths, plausible.astype(np.float32), strict=True)]
    each = [len(aims) for aims, _, _ in views]
    return _Candidates(
        centres=np.repeat(places[free], each, axis=0),
        forward=np.concatenate([aims for aims, _, _ in views]),
        tangent=np.repeat(tangents[free], each),
        worth=np.concatenate(worths),
        bins=np.repeat([bins for _, _, bins in views], each, axis=0),
        enclosed=np.repeat([np.mean(np.isfinite(horizons[place])) > _ENCLOSED for place in free], each),
        trained=remembered is not None,
    )


def _views_from(
    camera_centre: F64, tangent: float, horizon: F32, frame: _Frame, matter: _Matter
) -> tuple[F64, F32, NDArray[np.uint8]]:
    """Some directions to look in from one place, what each view shows of every target, and from which direction bin."""
    rays = matter.targets - camera_centre
    distance = np.linalg.norm(rays, axis=1)
    towards = rays / np.maximum(distance, 1e-300)[:, None]
    # A cell is wide: what is a little behind its nearest point may be the same surface.
    visible = (distance <= 1.1 * horizon[_cell(rays.T.astype(np.float32))] + 0.02) & (distance > frame.near)
    zoom = tangent / _HALF_VIEW
    shown = np.where(visible, np.minimum(1, (matter.reach / np.maximum(distance * zoom, 1e-12)) ** 2), 0)
    seen = np.flatnonzero(visible)
    if len(seen) == 0:
        aims = -camera_centre[None] / max(float(np.linalg.norm(camera_centre)), 1e-300)
    else:
        some = seen[((np.arange(_AIMS - 1) + 0.5) / (_AIMS - 1) * len(seen)).astype(np.int64)]
        middle = shown @ towards
        length = np.linalg.norm(middle)
        aims = np.concatenate([middle[None] / length if length > 1e-6 else towards[seen[:1]], towards[some]])
    ahead = towards @ aims.T
    # In the image's inscribed circle; a little beyond it, in the corners, counts no less than it costs.
    inside = ahead >= 1 / math.hypot(1, tangent)
    worth = np.where(inside, shown[:, None], 0).T.astype(np.float32)
    bins = (towards.astype(np.float32) @ _BIN_DIRECTIONS.T).argmax(axis=1).astype(np.uint8)
    return aims, worth, bins


def _energy(camera_centre: F64, matter: _Matter) -> F32:
    """(K,) squared deviation of the targets' colours from their mean, seen from ``camera centre``, for coefficients of
    norm 1.
    """
    rays = matter.targets - camera_centre
    towards = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-300)[:, None]
    basis = ac_basis(towards)[:, : matter.colours.shape[1]].astype(np.float32)
    deviation = np.einsum("km,kmc->kc", basis, matter.colours)
    energy: F32 = np.einsum("kc,kc->k", deviation, deviation)
    return energy


def _remembered(places: F64, shown: list[F32], matter: _Matter) -> F64 | None:
    """(places,) how well the colours of what one sees from a place remember a view from there; None: they cannot tell.

    It is the energy of the visible splats' colours towards the place, as a part of what the same splats have towards
    the best places. (Training moves coefficients along the basis functions of its views' directions, so their squared
    deviation, averaged over many splats, follows the density of the views.)
    """
    informative = matter.colours.any(axis=(1, 2))
    # A function of the first degree alone varies as much away from a view as towards it.
    if matter.colours.shape[1] < 8 or np.count_nonzero(informative) < _INFORMATIVE:
        return None
    energy = np.stack([_energy(place, matter) for place in places])
    weights = np.stack(shown) * informative
    total = np.maximum(weights.sum(axis=1), 1e-6)
    own = (weights * energy).sum(axis=1) / total
    best = np.quantile(weights @ energy.T / total[:, None], 0.95, axis=1)
    remembered: F64 = own / np.maximum(best, 1e-12)
    return remembered


def _pick(candidates: _Candidates, count: int) -> list[int]:
    """Greedily, by what each view adds.

    From outside, a room shows more than from inside. Where the colours do not tell which of the two it was made for,
    half of the views are inside whatever has one.
    """
    seen = np.zeros((candidates.worth.shape[1], _BINS), np.float32)
    inside = np.flatnonzero(candidates.enclosed)
    picked: list[int] = []
    if not candidates.trained and _FEW * len(candidates.enclosed) < len(inside) < len(candidates.enclosed):
        picked = _pick_among(inside, candidates, count // 2, seen)
    rest = np.setdiff1d(np.arange(len(candidates.enclosed)), picked)
    return picked + _pick_among(rest, candidates, count - len(picked), seen)


def _pick_among(views: NDArray[np.int64], candidates: _Candidates, count: int, seen: F32) -> list[int]:
    """At most ``count`` of the views; notes in ``seen`` (K, bins) what they show."""
    targets = np.arange(len(seen))

    def gain(view: int) -> float:
        return float(candidates.worth[view] @ (1 / (1 + seen[targets, candidates.bins[view]])))

    # Gains only fall, so an old one bounds the new one from above.
    heap = [(-gain(view), view) for view in views.tolist()]
    heapq.heapify(heap)
    picked: list[int] = []
    while heap and len(picked) < count:
        _, view = heapq.heappop(heap)
        now = gain(view)
        if heap and now < -heap[0][0]:
            heapq.heappush(heap, (-now, view))
            continue
        picked.append(view)
        seen[targets, candidates.bins[view]] += candidates.worth[view]
    return picked
