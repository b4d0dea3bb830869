"""What stages leave alone: splats that no view has resolved (:mod:`potr_cl.placement.guard`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.stages.stage import State


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

    def told(self) -> dict[str, Any]:
        """For programs."""
        return {"splats": self.splats, "of": self.of, "area": self.area, "kept": True}

    def __str__(self) -> str:
        return (
            f"no view shows {self.splats:,} splats ({100 * self.splats / self.of:.2g} %), "
            f"{100 * self.area:.2g} % of the scene's area, from near enough to judge them: kept as they are"
        )


def as_they_were(state: State) -> State:
    """A state in which stages have not changed what no view has resolved."""
    unresolved = state.learnt.unresolved
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
    unresolved = state.learnt.unresolved
    if unresolved is None:
        return effects
    rows = unresolved.among(state.survivors)
    if not rows.any() or rows.all():
        return effects
    found = effects.copy()
    found[rows] = np.maximum(effects[rows], np.median(effects[~rows]))
    return found
