"""Views to choose from: places in free space from where parts of the scene are seen, and what each view shows.

Each place belongs to a point on a surface that is seen from there: a ray from the point runs through free space, and
somewhere along it somebody could stand. So rooms are looked at from inside, things from all around, and nobody stands
in matter. How far from the point follows from the size of the splats there: near enough to resolve them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.sampling import F64, low_discrepancy, on_sphere
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import unit_coefficients
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.placement.rays import shown_from
from potr_cl.placement.space import NEAR, Space

F32 = NDArray[np.float32]

_SOURCE, _GROUP = "placement/energies.cl", 64
#: Splats with coefficients to speak of, below which colours tell nothing; and coefficients, with the constant one: a
#: function of the first degree varies as much away from a view as towards it.
_INFORMATIVE, _COEFFICIENTS = 100, 9
#: What counts as the best of some places: this quantile.
_BEST = 0.95


@dataclass(frozen=True)
class ViewMemory:
    """What the colours of some points remember of where they were trained from, and places to compare with.

    Training moves the coefficients of a splat along the basis functions of its views' directions, so the squared
    deviation of its colour, averaged over many splats, follows the density of the views (``energy`` in
    :mod:`potr_cl.model.spherical_harmonics`).

    Attributes:
        points: (K, 3) world units.
        colours: (K, M - 1, 3) AC coefficients of unit norm, 0 where there are none to speak of.
        best: (R, K) the energies towards the places that others are compared with.
    """

    device: Device
    space: Space
    points: F64
    colours: F32
    best: F32

    @staticmethod
    def of(device: Device, space: Space, points: F64, sh: F32, places: F64) -> ViewMemory | None:
        """What there is to remember; None: nothing.

        Args:
            device: computes.
            space: where the points are.
            points: (K, 3) world units.
            sh: (K, M, 3) the coefficients there.
            places: (R, 3) to compare with.
        """
        if sh.shape[1] < _COEFFICIENTS:
            return None
        colours = unit_coefficients(sh[:, 1:]).astype(np.float32)
        if np.count_nonzero(colours.any(axis=(1, 2))) < _INFORMATIVE:
            return None
        memory = ViewMemory(device, space, points, colours, np.empty((0, len(points)), np.float32))
        return ViewMemory(device, space, points, colours, memory._energies(places))

    def of_places(self, places: F64, shown: F32) -> F64:
        """How well places are remembered, (P,): as a part of how well the same points remember the best ones.

        Args:
            places: (P, 3).
            shown: (P, K) how well each shows each point, 0 to 1.
        """
        weights = shown * self.colours.any(axis=(1, 2))
        total = np.maximum(weights.sum(axis=1), 1e-6)
        own = np.einsum("pk,pk->p", weights, self._energies(places)) / total
        best = np.quantile(weights @ self.best.T / total[:, None], _BEST, axis=1)
        # Of a place that shows none of them nothing is known.
        found: F64 = np.where(weights.any(axis=1), own / np.maximum(best, 1e-12), 1.0)
        return found

    def _energies(self, places: F64) -> F32:
        """(P, K) towards places."""
        kernel = self.device.shared_kernel(_SOURCE, "energies", SH_COUNT=self.colours.shape[1] + 1)
        count = len(self.points)
        with Memory(self.device) as memory:
            found = memory.allocate(4 * count * len(places), "what colours remember")
            kernel.bind(
                places=memory.upload(self.space.in_cells(places, np.zeros(len(places))), "the places"),
                targets=memory.upload(self.space.in_cells(self.points, np.zeros(count)), "the points"),
                colours=memory.upload(np.ascontiguousarray(self.colours.reshape(count, -1).T), "the colours"),
                count=count,
                found=found,
            )
            kernel.launch((-(-count // _GROUP) * _GROUP, len(places)), (_GROUP, 1))
            return self.device.download(found, (len(places), count), np.float32)


#: Pixels that the larger standard deviation of a splat of median size has in photographs, as a rule.
USUAL = 3.0
#: What is asked for at most and least where colours tell from how far photographs were taken.
_COARSEST, _FINEST = 2.0, 4.5
#: The most that small pictures are asked for, as a part of the focal length: with more, each would show too little.
_OF_PICTURE = 0.0076
#: The distances that are tried, in those at which splats are resolved; rays for each; how well, as a part of the best,
#: the farthest is remembered at which photographs were taken; and their median distance as a part of that.
_DISTANCES, _TRIED, _AS_WELL, _MEDIAN = tuple(2.0 ** (step / 4) for step in range(-4, 9)), 600, 0.95, 0.85
#: The part of the targets that is spread over area.
_OVER_AREA = 0.25
#: Directions from which seeing a point counts as new.
BINS = 32
#: Views at each place.
AIMS = 5
#: How far a place is from its point, in distances at which that is resolved; of one place in so many, up to this.
_NEAREST, _FARTHEST, _FAR_PLACES, _OVERVIEW = 0.7, 2.0, 4, 6.0
#: The part of the free way from its point that a place is away at most, and the cells that it is away from matter.
_OF_WAY, _CLEAR = 0.7, 2
#: The longest lens, as a part of the usual field of view.
_LONGEST = 1e-6
#: What is seen from farther than this many times the distance at which it is resolved hardly counts.
_HARDLY = 6.0
#: The SH energy towards a view, as a part of the same splats' highest: below the first it was never trained, above the
#: second it was. Places among which the highest is looked for, and targets that are asked.
_UNTRAINED, _TRAINED, _COMPARED, _ASKED = 0.6, 0.8, 300, 1500

#: Directions that are looked in, and the part of them in which there must be matter, where a place counts as enclosed.
_AROUND, _ENCLOSED = on_sphere(low_discrepancy(24, 2)), 0.8
#: The part of the places that are enclosed where a scene has rooms.
_ROOMS = 0.15
_BIN_DIRECTIONS = on_sphere(low_discrepancy(BINS, 2)).astype(np.float32)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on surfaces, which views are judged by: most of them are spread over splats, some over area.

    Attributes:
        targets: (K, 3) world units.
        sizes: (K,) the larger standard deviation of splats near each, the geometric mean, world units.
        rows: (K,) numbers of the splats that they lie on.
    """

    targets: F64
    sizes: F64
    rows: NDArray[np.int64]

    @property
    def asked(self) -> int:
        """Each so many-th is asked what it remembers."""
        return max(len(self.targets) // _ASKED, 1)

    @staticmethod
    def of(scene: Scene, space: Space, count: int) -> SurfacePoints:
        """About so many of a scene."""
        over_area = round(_OVER_AREA * count)
        by_area = np.linspace(0, len(space.rows) - 1, over_area).astype(np.int64)
        by_splat = space.firsts[np.linspace(0, len(space.firsts) - 1, count - over_area).astype(np.int64)]
        chosen = np.union1d(by_area, by_splat)
        points = space.points[chosen]
        return SurfacePoints(points, space.sizes_near(points), space.rows[chosen])


@dataclass(frozen=True)
class Candidates:
    """Views to choose from, world units.

    Attributes:
        centres: (C, 3) positions.
        forward: (C, 3) unit vectors.
        tangent: (C,) tan of half the field of view.
        parts: of the arrays below, which belong to each view.
        shown: (E,) numbers of the targets that views show.
        worth: (E,) how well, 0 to 1.
        bins: (E,) from which of the directions.
        enclosed: (C,) whether there is matter nearly all around, as in rooms.
    """

    centres: F64
    forward: F64
    tangent: F64
    parts: list[slice]
    shown: NDArray[np.int64]
    worth: F32
    bins: NDArray[np.int64]
    enclosed: NDArray[np.bool_]

    @property
    def has_rooms(self) -> bool:
        """Whether a good part of the places is enclosed."""
        places = len(self.enclosed) // AIMS
        return bool(np.count_nonzero(self.enclosed[:places]) >= _ROOMS * places)


def candidates_of(
    device: Device,
    space: Space,
    targets: SurfacePoints,
    count: int,
    focal: float,
    half_view: float,
    pixels: float,
    memory: ViewMemory | None,
    first: int = 0,
) -> Candidates:
    """Views from about ``count`` places.

    Args:
        device: finds what is seen.
        space, targets: of the scene.
        focal: of the views, in pixels, where no lens has to be longer.
        half_view: tan of half the field of view.
        pixels, memory: as of :class:`Resolution`.
        first: which places of a sequence without end are tried.
    """
    places, seeds, tangents = _places(space, targets, count, focal / pixels, half_view, first)
    resolved = focal * half_view / tangents / pixels
    place, target, worth = shown_from(device, space, places, resolved, targets.targets, targets.sizes, NEAR, _HARDLY)
    rays = targets.targets[target] - places[place]
    towards = (rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)).astype(np.float32)
    starts = np.searchsorted(place, np.arange(len(places) + 1))
    if memory is not None:
        known = memory.of_places(places, _dense(place, target, worth, len(places), targets))
        worth *= np.clip((known - _UNTRAINED) / (_TRAINED - _UNTRAINED), 0, 1).astype(np.float32)[place]
    aims = _aims(places, targets.targets[seeds], starts, towards, worth)
    # In the image's inscribed circle; a little beyond it, in the corners, counts no less than it costs.
    least = 1 / np.hypot(1, tangents)[place]
    bins = np.concatenate([(part @ _BIN_DIRECTIONS.T).argmax(axis=1) for part in np.array_split(towards, 64)])
    chosen, parts, before = [], [], 0
    for aim in range(AIMS):
        inside = np.flatnonzero(np.einsum("pj,pj->p", towards, aims[place, aim].astype(np.float32)) >= least)
        ends = before + np.searchsorted(place[inside], np.arange(len(places) + 1))
        parts += [slice(a, b) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]
        before += len(inside)
        chosen.append(inside)
    every = np.concatenate(chosen)
    return Candidates(
        centres=np.tile(places, (AIMS, 1)),
        forward=aims.transpose(1, 0, 2).reshape(-1, 3),
        tangent=np.tile(tangents, AIMS),
        parts=parts,
        shown=target[every],
        worth=worth[every],
        bins=bins[every],
        enclosed=np.tile(_enclosed(space, places), AIMS),
    )


def _enclosed(space: Space, places: F64) -> NDArray[np.bool_]:
    """(P,) whether rays in nearly all directions meet matter."""
    rays = np.tile(_AROUND, (len(places), 1))
    far = np.full(len(rays), 2 * space.cell * sum(space.shape))
    met = space.reach(np.repeat(places, len(_AROUND), axis=0), rays, far) < far
    found: NDArray[np.bool_] = np.mean(met.reshape(len(places), -1), axis=1) >= _ENCLOSED
    return found


def _places(
    space: Space, targets: SurfacePoints, count: int, resolved_from: float, half_view: float, first: int
) -> tuple[F64, NDArray[np.int64], F64]:
    """(P, 3) where to stand, (P,) the target that each place belongs to, and (P,) half the field of view there."""
    spread = low_discrepancy(first + count, 4)[first:]
    seeds = (spread[:, 0] * len(targets.targets)).astype(np.int64)
    away = on_sphere(spread[:, 1:3])
    resolved = resolved_from * targets.sizes[seeds]
    farthest = np.where(np.arange(count) % _FAR_PLACES, _FARTHEST, _OVERVIEW)
    wanted = resolved * _NEAREST * (farthest / _NEAREST) ** spread[:, 3]
    # A place nearer than the near plane steps back, and has a longer lens.
    distance = np.maximum(wanted, NEAR * 1.5)
    off = min(2.5 * space.cell, 0.3 * float(np.median(distance)))
    start = targets.targets[seeds] + off * away
    way = off + space.reach(start, away, 2 * distance)
    tangents = half_view * np.clip(wanted / distance, _LONGEST, 1)
    distance = np.minimum(distance, _OF_WAY * way)
    places = targets.targets[seeds] + distance[:, None] * away
    fits = (space.free(places) >= _CLEAR) & (distance > NEAR)
    if np.count_nonzero(fits) < count // 20:  # nothing is free: what is not occupied has to do
        fits = distance > NEAR
    if not fits.any():
        fits[:] = True
    return places[fits], seeds[fits], tangents[fits]


def _aims(places: F64, seeds: F64, starts: NDArray[np.int64], towards: F32, worth: F32) -> F64:
    """(P, A, 3) directions to look in: at the place's own target, at the middle of what is seen, and at some of it."""
    first = seeds - places
    length = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(length > 0, first / np.maximum(length, 1e-300), [1.0, 0.0, 0.0])
    aims = np.repeat(first[:, None], AIMS, axis=1)
    some = np.flatnonzero(np.diff(starts))
    if len(some):
        # Empty parts give what stands at their start: they are left out.
        middle = np.add.reduceat(towards * worth[:, None], starts[some], dtype=np.float64)
        length = np.linalg.norm(middle, axis=1)
        clear = length > 1e-6
        aims[some[clear], 1] = middle[clear] / length[clear, None]
        for number in range(AIMS - 2):
            at = starts[some] + ((number + 0.5) / (AIMS - 2) * np.diff(starts)[some]).astype(np.int64)
            aims[some, 2 + number] = towards[at]
    return aims


def _dense(place: NDArray[np.int64], target: NDArray[np.int64], worth: F32, places: int, targets: SurfacePoints) -> F32:
    """(P, K) how well places show the targets that are asked."""
    found = np.zeros((places, len(targets.targets[:: targets.asked])), np.float32)
    asked = np.flatnonzero(target % targets.asked == 0)
    found[place[asked], target[asked] // targets.asked] = worth[asked]
    return found


@dataclass(frozen=True)
class Resolution:
    """From how near to look at a scene.

    Attributes:
        pixels: that the larger standard deviation of a splat of median size should have.
        limited: whether photographs were not taken from as far as was tried, as colours or walls tell.
        memory: what colours remember; None: nothing.
    """

    pixels: float
    limited: bool
    memory: ViewMemory | None


def resolution(device: Device, scene: Scene, space: Space, targets: SurfacePoints, focal: float) -> Resolution:
    """From as near as photographs were taken, where colours remember it; else as near as they usually are.

    Args:
        focal: of the views, in pixels.
    """
    spread = low_discrepancy(_TRIED, 3)
    seeds = (spread[:, 0] * len(targets.targets)).astype(np.int64)
    away = on_sphere(spread[:, 1:])
    resolved = focal * float(np.median(targets.sizes)) / USUAL
    start = targets.targets[seeds] + min(2.5 * space.cell, 0.1 * resolved) * away
    way = space.reach(start, away, np.full(_TRIED, _DISTANCES[-1] * resolved))
    rings = []
    for times in _DISTANCES:
        places = targets.targets[seeds] + times * resolved * away
        rings.append(places[(way >= times * resolved * 0.99) & (space.free(places) >= _CLEAR)])
    every = np.concatenate(rings)
    asked = slice(None, None, targets.asked)
    if not len(every):
        return Resolution(USUAL, False, None)
    compared = every[:: max(len(every) // _COMPARED, 1)]
    memory = ViewMemory.of(device, space, targets.targets[asked], scene.sh[targets.rows[asked]], compared)
    if memory is None or scene.sh_degree < 3:  # too smooth to tell distances
        return Resolution(USUAL, False, memory)
    place, target, worth = shown_from(
        device,
        space,
        every,
        np.full(len(every), focal / USUAL),
        memory.points,
        targets.sizes[asked],
        NEAR,
        10 * _HARDLY,
    )
    shown = np.zeros((len(every), len(memory.points)), np.float32)
    shown[place, target] = worth
    known = np.split(memory.of_places(every, shown), np.cumsum([len(ring) for ring in rings])[:-1])
    usual = np.array([np.quantile(ring, 0.75) if len(ring) else 0.0 for ring in known])
    farthest = int(np.flatnonzero(usual >= _AS_WELL * usual.max())[-1])
    finest = max(min(_FINEST, _OF_PICTURE * focal), USUAL)
    pixels = float(np.clip(USUAL / (_MEDIAN * _DISTANCES[farthest]), _COARSEST, finest))
    return Resolution(pixels, farthest < len(_DISTANCES) - 1, memory)
