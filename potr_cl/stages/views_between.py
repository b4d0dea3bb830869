"""The stage "between": look at the scene from between the training views, too.

How many views a scene needs (:func:`needed`), how many of these fit the memory (:func:`room_for`), and what a splat may
cost where views show a part of the scene (:func:`priced`).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import UsageError
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera, spread_evenly
from potr_cl.model.given_views import GivenViews
from potr_cl.model.scene import Scene
from potr_cl.model.views_between import SPREAD, views_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import fits_whole
from potr_cl.raster.rules import INRIA
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.pruning.buffers import PreparedSet
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option
from potr_cl.views.budget import SCENES, default_memory
from potr_cl.views.visibility import MOST_SEEN, Visibility, groups_of_large, seen_part

#: Views that should show each part of a scene: twice the 16 coefficients that a colour channel of a splat has. With
#: fewer, many colours fit what the views show, and the one that is chosen need not fit what lies between them.
_ENOUGH = 32
#: The part of the scene that may be shown by fewer.
_PART = 0.25
#: Fewer than this for each training view bring too little.
_LEAST = 0.25
_MOST_ADDED, _MOST_ADDED_ON_CPU = 5.0, 2.0
#: An added view takes as much time as a training view. So that an encode takes at most 1.6 times as long, added views
#: are a part of the training views, and some more where an encode does much besides looking at views, as on GPUs.
_SHARE = 0.45
#: Where fewer views than this show parts of the scene, what lies between is matched many decibels worse than they are.
#: There an encode may take up to 2.2 times as long.
_FEW, _SHARE_OF_FEW = 10, 1.0
_BESIDES, _BESIDES_ON_CPU = 45, 4


def needed(shown_by: float, views: int, slow: bool) -> float:
    """How many to add for each training view.

    Args:
        shown_by: how many training views show the scene where few do, as :func:`views_where_few` finds it.
        slow: whether a CPU has to look at them.
    """
    each = min(_ENOUGH / max(shown_by, 1.0) - 1, most_needed(views, slow, shown_by < _FEW))
    return each if each >= _LEAST else 0.0


def views_where_few(views_of_parts: NDArray[np.int64]) -> float:
    """How many views at most show the quarter of a scene that the fewest show.

    Args:
        views_of_parts: (K,) how many training views show each part of the scene
            (:meth:`potr_cl.model.given_views.GivenViews.views_of_parts`), at least one.
    """
    return float(np.quantile(views_of_parts, _PART))


def most_needed(views: int, slow: bool, few: bool = False) -> float:
    """How many are added for each of so many training views at most; ``few``: whether few of them show some part."""
    most, besides = (_MOST_ADDED_ON_CPU, _BESIDES_ON_CPU) if slow else (_MOST_ADDED, _BESIDES)
    return min(most, (_SHARE_OF_FEW if few else _SHARE) + besides / views)


#: More bytes than a view takes, for each splat and each pixel: where there are so many, nothing has to be measured.
_SPLAT, _PIXEL = 500, 200
#: Views whose memory is measured.
_SAMPLE = 3
#: By how much others may take more than those measured; and how much more, where views of a part share its splats.
_MARGIN, _MARGIN_OF_PARTS = 1.1, 1.6


def room_for(added: Sequence[Camera], state: State, bench: Workbench) -> int:
    """How many of some views fit the memory, on the average, beside those of a state.

    A view that does not fit is made again for each measurement. So added views that take the room of others cost many
    times what they should, and only as many are added as there is room for. But where views are made again in batches,
    each with what it may draw (:func:`potr_cl.views.plan.by_view`), an added one costs no more than a given one.

    Args:
        added: the views that might be added.
        state: its views come first.
        bench: of the stage that asks; its memory is what there is.
    """
    if not added:
        return 0
    budget = default_memory(bench.opened) if bench.memory is None else bench.memory
    pixels = sum(view.width * view.height for view in (*state.views, *added))
    if budget > _SPLAT * len(state.source) * (len(state.views) + len(added)) + _PIXEL * pixels:
        return len(added)
    sampled = spread_evenly(state.views, _SAMPLE), spread_evenly(added, _SAMPLE)
    if seen_part(state.source, state.views) <= MOST_SEEN:
        device = bench.opened
        if bench.all_here and device.family == "gpu" and fits_whole(device, bench.drawable(state.source)):
            return len(added)
        own, more = (_nbytes_of_parts(state, bench, views) for views in sampled)
        # Views in hand take room too, and parts are larger than what a view sees of them.
        left, margin = budget - min(SCENES * budget, state.source.nbytes) - 2 * max(own, more), _MARGIN_OF_PARTS
    else:
        own, more = (_nbytes(bench, bench.drawable(state.source), views) for views in sampled)
        left, margin = budget, _MARGIN
    left -= margin * own * len(state.views)
    return int(min(max(left // (margin * more), 0), len(added)))


def _nbytes_of_parts(state: State, bench: Workbench, views: Sequence[Camera]) -> float:
    """Bytes that is kept of a view where it is looked at with what it may draw and no more: the mean of some."""
    source = state.source
    with thread_pool(bench.threads) as pool:
        visibility = Visibility.of(source, views, INRIA.near, groups_of_large(source, pool.map), pool.map)
    held = [
        _nbytes(bench, source.subset(visibility.groups.splats(seen)), [view])
        for view, seen in zip(views, visibility.seen, strict=True)
        if seen.any()
    ]
    return float(np.mean(held)) if held else 1.0


def _nbytes(bench: Workbench, scene: Drawable, views: Sequence[Camera]) -> float:
    """Bytes that is kept of a view while splats are removed: the mean of some."""
    with Rasterizer(bench.opened, scene, background=bench.background) as rasterizer:
        with ExitStack() as prepared, rasterizer.preparing_many():
            for view in views:
                prepared.enter_context(PreparedSet(rasterizer, rasterizer.prepare_set([view])))
            held = rasterizer.device.allocated
        # What the rasterizer works with is there before and after.
        return (held - rasterizer.device.allocated) / len(views)


#: Which part of the views shows a splat, on the average, in a scene that is seen whole: an object hides half of itself,
#: and a captured one is seen from near and from afar.
_WHOLE = 0.25


def priced(parameters: HyperParameters, state: State) -> HyperParameters:
    """What q gives, with the thresholds on the mean squared error as they are right for a state's views.

    Errors are means over all views. Where each view shows the whole scene, a splat that makes every picture a little
    worse counts as much as one that makes one picture much worse. Where each view shows a part, in a city or in a flat
    of many rooms, no splat can make more than a few pictures worse. With the same threshold the more would go, the
    larger the scene is, and each picture would be matched the worse. So the threshold is a part of that for a scene
    that is seen whole.

    Args:
        parameters: of a scene that is seen whole.
        state: knows which part of the views shows a splat, if anyone has found out.
    """
    part = min(state.results.shown / _WHOLE, 1.0)
    return replace(parameters, delta_mse_max=part * parameters.delta_mse_max, drop=part * parameters.drop)


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
            (:mod:`potr_cl.stages.views_between`). Then views are looked at even if none is added.

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
        """Add them; ``results`` gets an :class:`Added`, if any are asked for.

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
            state = state.with_results(known=known)
            if self.weigh and (shown := known.part_of_views()) is not None:
                state = state.with_results(shown=shown)
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
        return then.with_results(between=Added(given, len(added), shown_by))


def _evenly(views: Sequence[Camera], count: int) -> list[Camera]:
    """So many of some views, spread evenly over their order."""
    return [views[number * len(views) // count] for number in range(count)]
