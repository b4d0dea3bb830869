"""The stage "between": look at the scene from between the training views, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from potr_cl.errors import UsageError
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.given_views import GivenViews
from potr_cl.model.scene import Scene
from potr_cl.model.views_between import SPREAD, views_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.stages.between.amount import needed, views_where_few
from potr_cl.stages.between.room import room_for
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option

_MOST_ASKED = 100
#: That look at views.
_THREADS = 4


def _number(text: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    try:
        return 0.0 if text == "off" else float(text)
    except ValueError:
        raise UsageError(f"--views-between is '{text[:40]}': give a number of views, auto, or off") from None


@dataclass(frozen=True)
class Added:
    """What the stage has added.

    Attributes:
        given: the number of training views that were given.
        added: of views between them.
        shown_by: how many given views at most show the quarter of the scene that the fewest show; None if nobody asked,
            or they show nothing.
    """

    given: int
    added: int
    shown_by: float | None = None

    def __str__(self) -> str:
        views = "view" if self.added == 1 else "views"
        return f"{self.added or 'no'} extra {views} between the {self.given} training views"


@dataclass(frozen=True)
class Between(Stage):
    """Add views between the training views, so that the scene keeps what is seen from there.

    Where views were placed, as many as are needed have been, so auto adds none.

    Attributes:
        views: how many to add for each training view; 0.5: one for every second; 0: none; "auto": as many as the scene
            needs, and as fit the memory for views.
        spread: how far they are off the way to a neighbouring view, as a part of that way: one standard deviation.
        weigh: whether what a splat may cost follows from the part of the views that show it
            (:mod:`potr_cl.stages.between.price`). Then views are looked at even if none is added.

    Raises:
        UsageError: a value is out of range.
    """

    name = "between"
    title = "views between the training views"
    serves_others = True

    views: float | Literal["auto"] = option(
        "auto",
        Flag(
            "--views-between",
            "extra views per training view, between it and its neighbours; 0.5: one for every second; auto: as many "
            "as the scene needs; off: none",
            "N",
            _number,
            default="the preset's: auto, but off in paper",
        ),
    )
    spread: float = option(SPREAD)
    weigh: bool = option(True)

    def __post_init__(self) -> None:
        if self.views != "auto" and not (isinstance(self.views, (int, float)) and 0 <= self.views <= _MOST_ASKED):
            raise UsageError(f"--views-between is {self.views}, it must be from 0 to {_MOST_ASKED}, or auto")
        if not 0 <= self.spread <= 10:
            raise UsageError(f"the spread of the views between is {self.spread:g}, it must be from 0 to 10")

    @property
    def asked_for(self) -> bool:
        return self.on and (self.weigh or self.views != 0)

    def looks_at(self, scene: Scene) -> bool:
        return self.asked_for

    def run(self, state: State, bench: Workbench) -> State:
        """Add them; ``learnt`` gets an :class:`Added`, if any are asked for.

        And as "shown" which part of the given views shows a splat on the average.
        """
        given = len(state.views)
        if given < 2 or state.added:
            return state
        slow = bench.opened.info.kind == "cpu"
        virtual = is_virtual(state.views)
        bench.progress("views between", 0.0)
        # More wait for each other longer than they work.
        with thread_pool(min(bench.threads or _THREADS, _THREADS)) as pool:
            known = GivenViews(state.source, state.views, pool.map)
            parts = known.views_of_parts()
            if self.weigh and (shown := known.part_of_views()) is not None:
                state = state.having_learnt(shown=shown)
            each, shown_by = 0.0 if virtual and self.views == "auto" else self.views, None
            if each == "auto":
                each = 0.0
                if len(parts):
                    shown_by = views_where_few(parts)
                    each = needed(shown_by, given, slow)
            added = views_between(state.source, state.views, each, self.spread, known=known, run=pool.map)
        if added and self.views == "auto":
            added = _evenly(added, room_for(added, state, bench))
        bench.progress("views between", 1.0)
        if self.views == 0 or (virtual and not added):
            return state
        then = replace(state, views=(*state.views, *added), added=len(added))
        return then.having_learnt(between=Added(given, len(added), shown_by))


def _evenly(views: Sequence[Camera], count: int) -> list[Camera]:
    """So many of some views, spread evenly over their order."""
    return [views[number * len(views) // count] for number in range(count)]
