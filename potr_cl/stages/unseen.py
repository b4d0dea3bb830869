"""Splats that no training view sees (:class:`Unseen`): they are kept, while the others are pruned without them. And
those that no view has resolved (:class:`Unresolved`), which stages leave alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run, in_background
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.splat_groups import SplatGroups, opacity_weighted_areas, unseen_splats
from potr_cl.stages.pruning.schedule import Course, Pruned
from potr_cl.stages.stage import State
from potr_cl.views.reached import Seen


@dataclass(frozen=True)
class Unresolved:
    """The splats of the uncompressed scene that no view has resolved.

    Attributes:
        mask: (N,) whether each is one.
        find_area: returns their part of the scene's opacity-weighted area.
    """

    mask: NDArray[np.bool_]
    find_area: Callable[[], float] = field(repr=False, compare=False)

    @property
    def splats(self) -> int:
        """How many they are."""
        return int(np.count_nonzero(self.mask))

    @property
    def of(self) -> int:
        """How many splats the scene has."""
        return len(self.mask)

    def among(self, survivors: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(n,) the same of those that are left."""
        return self.mask if len(survivors) == len(self.mask) else self.mask[survivors]

    @property
    def area(self) -> float:
        """Their part of the scene's opacity-weighted area, 0 to 1."""
        return self.find_area()

    @property
    def facts(self) -> dict[str, Any]:
        """All by name."""
        return {"splats": self.splats, "of": self.of, "area": self.area, "kept": True}

    def __str__(self) -> str:
        return (
            f"no view shows {self.splats:,} splats ({100 * self.splats / self.of:.2g} %), "
            f"{100 * self.area:.2g} % of the scene's area, from near enough to judge them: kept as they are"
        )


def as_they_were(state: State) -> State:
    """A state in which stages have not changed what no view has resolved."""
    unresolved = state.results.unresolved
    if unresolved is None or state.scene is state.source:
        return state
    rows = np.flatnonzero(unresolved.among(state.survivors))
    source, scene = state.survivors[rows], state.scene
    changed: dict[str, Any] = {}
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        now, before = getattr(scene, name), getattr(state.source, name)
        if now is before or np.array_equal(now[rows], before[source]):
            continue
        changed[name] = now.copy()
        changed[name][rows] = before[source]
    if not changed:
        return state
    geometry = state.geometry if changed.keys() == {"sh"} else None
    return replace(state, scene=replace(scene, **changed), geometry=geometry, cut=None)


def as_important(effects: FloatArray, state: State) -> FloatArray:
    """What errors of splats cost, (n,), where what no view has resolved counts as the middle of the others at least."""
    unresolved = state.results.unresolved
    if unresolved is None:
        return effects
    rows = unresolved.among(state.survivors)
    if not rows.any() or rows.all():
        return effects
    found = effects.copy()
    found[rows] = np.maximum(effects[rows], np.median(effects[~rows]))
    return found


#: What can be done with them.
CHOICES = ("keep", "drop", "protect")


@dataclass(frozen=True)
class Unseen:
    """The splats that no training view sees.

    Attributes:
        kept: whether they were kept, without what of their colours depends on the direction.
        find_area: returns their part of the scene's opacity-weighted area, once that is known.
    """

    splats: int
    of: int
    kept: bool
    find_area: Callable[[], float] = dataclasses.field(repr=False, compare=False)

    @property
    def area(self) -> float:
        """Their part of the scene's opacity-weighted area, 0 to 1."""
        return self.find_area()

    @property
    def facts(self) -> dict[str, Any]:
        """All by name."""
        return {"splats": self.splats, "of": self.of, "area": self.area, "kept": self.kept}

    def __str__(self) -> str:
        what = "kept, coarsely coded" if self.kept else "dropped"
        part = self.splats / self.of
        return (
            f"no training view sees {self.splats:,} splats ({100 * part:.2g} %), {100 * self.area:.2g} % of the "
            f"scene's opacity-weighted area: {what}"
        )


def find_unseen(
    state: State,
    groups: SplatGroups | None = None,
    run: Run = map,
    surely_seen: Callable[[Sequence[Camera]], NDArray[np.uint8]] | None = None,
) -> tuple[NDArray[np.bool_], Callable[[], float]]:
    """Which splats of a state no given training view sees, and what returns their part of the opacity-weighted area.

    Nothing but a report needs that part, so it is found in a thread of its own. Added views do not count: the one that
    happens to see a splat, perhaps from afar, cannot say what it is worth.

    Args:
        state: whose scene and views.
        groups: of the scene, where they are known.
        surely_seen: finds quickly which splats some views see, (N,) :class:`potr_cl.views.reached.Seen`; those
            that it leaves undecided are looked at here.
    """
    views, scene = state.given, state.scene
    if surely_seen is None:
        unseen = unseen_splats(scene, views, groups, run)
    else:
        found = surely_seen(views)
        unseen = found == Seen.NO
        rest = np.flatnonzero(found == Seen.UNDECIDED)
        if len(rest):
            unseen[rest] = unseen_splats(scene.subset(rest), views, None, run)
    if not unseen.any():  # as usual
        return unseen, float
    return unseen, in_background(part_of_area, scene, unseen).result


def part_of_area(scene: Scene, splats: NDArray[np.bool_]) -> float:
    """The part of a scene's opacity-weighted area that some splats have, (N,), 0 to 1."""
    areas = opacity_weighted_areas(scene, map)
    return float(areas[splats].sum() / max(float(areas.sum()), 1e-300))


def without_directions(state: State, unseen: NDArray[np.bool_]) -> State:
    """The state after some splats have lost what of their colours depends on the direction.

    Args:
        state: whose scene it is; nobody else may have its colours, which change in place: a copy would take as much
            memory as a large scene has left.
        unseen: (n,) which of its scene's splats these are.
    """
    sh = state.scene.sh
    sh[np.flatnonzero(unseen), 1:] = 0
    return state.recoloured(sh)


def as_of_whole(seen: NDArray[np.int64], hidden: NDArray[np.bool_], pruned: Pruned) -> Pruned:
    """What pruning did to the splats that views see, as what it did to all: the others were kept, nobody misses them.

    Args:
        seen: (n,) their numbers, ascending.
        hidden: (N,) which are the others.
        pruned: what was done to those that are seen.
    """
    unseen = np.flatnonzero(hidden)
    iteration_of = np.full(len(unseen) + len(seen), -1, np.int32)
    iteration_of[seen] = pruned.iteration_of
    importance = np.zeros(len(iteration_of), np.float32)
    importance[seen] = pruned.importance

    def course() -> Course:
        own = pruned.course()
        # Those that no view sees would go before all that are left.
        score = np.full(len(iteration_of), -np.inf)
        score[seen] = own.score
        return Course(score, tuple(dataclasses.replace(each, left=each.left + len(unseen)) for each in own.history))

    return Pruned(pruned.kept + len(unseen), iteration_of, pruned.iterations, importance, course)
