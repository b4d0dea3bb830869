"""What given views show of a scene, and where a camera might have been besides: :class:`GivenViews`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.matter import CROWDED, Matter, frame_of, horizons_of, matter_of, shown_of
from potr_cl.model.sampling import F64
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import energy

F32 = NDArray[np.float32]
S = TypeVar("S")
T = TypeVar("T")

#: So many splats, evenly taken, tell where a scene is; views are judged by so many of them, and points that hide them.
_TAKEN, _TARGETS, _OCCLUDERS = 20_000, 1_000, 8_000
#: Nothing is taken to be farther away, in the frame's units: squares of it are finite in single precision.
_FARTHEST = 1e18
#: Views that a thread looks at before the next one gets its turn.
_AT_ONCE = 16
#: Part of what a new view shows that some given view must show, too.
_KNOWN = 0.9
#: A new view shows at least this part of what the view shows that it lies beside, by number of splats.
_FULL = 0.5
#: What colours remember of a new view's place, as a part of the least that they remember of given ones.
_REMEMBERED = 0.95


class GivenViews:
    """A scene as given views see it.

    Args:
        scene: that they show.
        cameras: the given views, at least one.
        run: in place of :func:`map`, to work with several threads.
    """

    def __init__(self, scene: Scene, cameras: Sequence[Camera], run: Run = map) -> None:
        every = max(len(scene) // _TAKEN, 1)
        some = scene.of_arrays([each[::every] for each in scene.arrays])
        self._frame = frame_of(some, run)
        matter = matter_of(some, self._frame, _TARGETS, _OCCLUDERS)
        # Each point stands for the surface of the splats that were not taken, too.
        self._matter = dataclasses.replace(matter, areas=matter.areas * np.float32(every))
        shown, blocked = zip(*_some_at_a_time(self._look, cameras, run), strict=True)
        self._shown: F32 = np.stack(shown)
        self._known: F32 = self._shown.max(axis=0)
        # Whoever photographs indoors, stands close to things.
        self._crowded = max(CROWDED, *blocked)
        self._places = np.stack([self._place(camera) for camera in cameras])
        self._fields = np.array([c.width * c.height / (c.fx * c.fy) for c in cameras])

    @cached_property
    def memory(self) -> tuple[ColourMemory, float]:
        """What colours remember of given places, and the least that they must remember of others."""
        memory = ColourMemory(self._places, self._matter)
        if not memory.tells:
            return memory, 0.0
        return memory, _REMEMBERED * min(memory.of_known(*given) for given in enumerate(self._shown))

    def views_of_parts(self) -> NDArray[np.int64]:
        """(K,) how many given views show each of some splats, evenly taken; those that none shows are left out."""
        counts: NDArray[np.int64] = np.count_nonzero(self._shown, axis=0)
        return counts[counts > 0]

    def part_of_views(self) -> float | None:
        """Which part of the given views shows a splat, on the average over those that any shows; None: none is shown.

        A view counts by the part of its picture that the splat takes up: whoever sees all of a city from afar sees
        little of each house. With weights w of V views, the part is (Σ w)² / (V Σ w²), 1 if all show the splat alike
        and 1 / V if one alone does (Kish 1965, effective sample size).
        """
        x, y, z = (
            (axis - places[:, None]) ** 2 for axis, places in zip(self._matter.targets.T, self._places.T, strict=True)
        )
        squares = np.maximum(x + y + z, 1e-12)
        sizes = self._shown / (self._fields[:, None] * squares)
        sizes = sizes[:, self._shown.any(axis=0)]
        if not sizes.size:
            return None
        return float((sizes.sum(axis=0) ** 2 / (len(sizes) * (sizes**2).sum(axis=0))).mean())

    def allows(self, camera: Camera, beside: int) -> bool:
        """Whether a camera might have been where it is.

        That is: not in matter, not where the colours do not remember that they were looked at from there, and not where
        it would show what no given view shows.

        Args:
            camera: the view.
            beside: number of the given view that it lies beside.
        """
        if not np.isfinite(camera.translation).all():
            return False
        shown, blocked = self._look(camera)
        total = float(shown.sum())
        if blocked > self._crowded or total < _FULL * float(self._shown[beside].sum()):
            return False
        if total > 0 and float((shown * self._known).sum()) < _KNOWN * total:
            return False
        memory, least = self.memory
        return not memory.tells or memory.of(self._place(camera), shown) >= least

    def _look(self, camera: Camera) -> tuple[F32, float]:
        """(K,) 1 for each target that a view shows, else 0; and how much matter there is close by it."""
        frame, place = self._frame, self._place(camera)
        horizons, blocked = horizons_of(place, self._matter)
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, frame.near)
        return shown_of(np.array([*place, *camera.rotation.flat, *lens]), horizons, self._matter), blocked

    def _place(self, camera: Camera) -> F64:
        place: F64 = np.clip((camera.centre - self._frame.centre) / self._frame.unit, -_FARTHEST, _FARTHEST)
        return place


def _some_at_a_time(work: Callable[[S], T], of: Sequence[S], run: Run) -> list[T]:
    """What comes of each: threads wait for each other longer than one takes."""
    parts = [of[first : first + _AT_ONCE] for first in range(0, len(of), _AT_ONCE)]
    return [each for found in run(lambda some: [work(one) for one in some], parts) for each in found]


#: Targets with coefficients to speak of, below which that is not asked.
_INFORMATIVE = 100
#: The best of the known places are those at this quantile.
_BEST = 0.95


class ColourMemory:
    """What colours remember, measured against some places that they are known, or thought, to be seen from.

    That is the energy of the visible splats' colours towards a place, as a part of what the same splats have towards
    the best of those places. (Training moves coefficients along the basis functions of its views' directions, so their
    squared deviation, averaged over many splats, follows the density of the views.)

    Args:
        places: (P, 3) positions in the frame's units.
        matter: of the scene.
        run: in place of :func:`map`, to work with several threads.

    Attributes:
        tells: whether the colours can tell anything.
    """

    def __init__(self, places: F64, matter: Matter, run: Run = map) -> None:
        self._matter = matter
        self._informative = matter.colours.any(axis=(1, 2))
        # A function of the first degree alone varies as much away from a view as towards it.
        self.tells = matter.colours.shape[1] >= 8 and np.count_nonzero(self._informative) >= _INFORMATIVE
        self._energies = np.stack(list(run(self._energy, places))) if self.tells else None

    def of(self, place: F64, shown: F32) -> float:
        """How well they remember a place, (3,), from where ``shown``, (K,), is seen, 0 to 1."""
        weights = shown * self._informative
        total = max(float(weights.sum()), 1e-6)
        own = float(weights @ self._energy(place)) / total
        return own / self._best(weights, total)

    def of_known(self, number: int, shown: F32) -> float:
        """The same of one of the places that are known, by its number."""
        assert self._energies is not None
        weights = shown * self._informative
        total = max(float(weights.sum()), 1e-6)
        return float(weights @ self._energies[number]) / total / self._best(weights, total)

    def _best(self, weights: F32, total: float) -> float:
        """How well the best of the known places are remembered by the same splats."""
        assert self._energies is not None
        # Without BLAS, whose threads would wait for each other where several threads ask, and np.quantile, which takes
        # longer than all the rest.
        energies = np.sort(np.einsum("pk,k->p", self._energies, weights)).tolist()
        below, part = divmod(_BEST * (len(energies) - 1), 1)
        low, high = energies[int(below)], energies[min(int(below) + 1, len(energies) - 1)]
        return max(float((low + part * (high - low)) / total), 1e-12)

    def _energy(self, place: F64) -> F32:
        """(K,) of the targets' colours, as they are seen from a place."""
        return energy(self._matter.targets - place, self._matter.colours)
