"""The stage "between": look at the scene from between the training views, too."""

from __future__ import annotations

from dataclasses import dataclass, replace

from potr_cl.errors import UsageError
from potr_cl.model.scene import Scene
from potr_cl.model.views_between import SPREAD, views_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.stages.between.trial import Trial, try_views
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option

#: The most views that are added for each training view if the scene decides. On CPUs, where each takes nearly as long
#: as a training view, every second training view gets one.
_MOST, _MOST_ON_CPU, _EVERY_ON_CPU = 2, 1, 2
_MOST_ASKED = 100


def _number(text: str) -> int | None:
    if text in ("auto", "off"):
        return None if text == "auto" else 0
    if not text.isdecimal() or len(text) > 9:
        raise UsageError(f"--views-between is '{text[:40]}': give a number of views, auto, or off")
    return int(text)


@dataclass(frozen=True)
class Between(Stage):
    """Add views between the training views, so that the scene keeps what is seen from there.

    Virtual cameras are spread so that nothing has to be added.

    Attributes:
        views: how many to add for each training view; None: as many as the scene needs; 0: none.
        spread: how far they are off the way to a neighbouring view, as a part of that way: one standard deviation.

    Raises:
        UsageError: a value is out of range.
    """

    name = "between"
    title = "views between the training views"
    serves_others = True

    views: int | None = option(
        None,
        Flag(
            "--views-between",
            "views to look at besides, for each training view, between it and its neighbours; off: none",
            "N",
            _number,
            default="auto, as many as the scene needs",
        ),
    )
    spread: float = option(SPREAD)

    def __post_init__(self) -> None:
        if self.views is not None and not 0 <= self.views <= _MOST_ASKED:
            raise UsageError(f"--views-between is {self.views}, it must be from 0 to {_MOST_ASKED}")
        if not 0 <= self.spread <= 10:
            raise UsageError(f"the spread of the views between is {self.spread:g}, it must be from 0 to 10")

    @property
    def asked_for(self) -> bool:
        return self.on and self.views != 0

    def looks_at(self, scene: Scene) -> bool:
        return self.asked_for

    def run(self, state: State, bench: Workbench) -> State:
        """Add them; ``learnt`` gets a :class:`potr_cl.stages.between.trial.Trial`."""
        if is_virtual(state.views) or len(state.views) < 2 or state.added:
            return state
        bench.progress("views between", 0.0)
        slow = bench.opened.info.kind == "cpu"
        if self.views is None:
            trial = try_views(state, bench, self.spread, _MOST_ON_CPU if slow else _MOST, brief=slow)
        else:
            trial = Trial(self.views)
        added = views_between(state.source, state.views, trial.each, self.spread)
        if slow and self.views is None:
            added = added[::_EVERY_ON_CPU]
        bench.progress("views between", 1.0)
        return replace(state, views=(*state.views, *added), added=len(added)).having_learnt(self.name, trial)
