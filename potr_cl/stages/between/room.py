"""How many added views fit the memory that views may fill (:func:`room_for`).

A view that does not fit is made again for each measurement. So added views that take the room of others cost many times
what they should, and only as many are added as there is room for. Where views are made again in batches, each with what
it may draw (:func:`potr_cl.views.plan.by_view`), they cost less: half as many as were given are added anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np

from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.raster.kept_scene import fits_whole
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.pruning.prepared_set import PreparedSet
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.budget import SCENES, default_memory
from potr_cl.views.visibility import MOST_SEEN, Visibility, groups_of_large, seen_part

#: More bytes than a view takes, for each splat and each pixel: where there are so many, nothing has to be measured.
_SPLAT, _PIXEL = 500, 200
#: Views whose memory is measured.
_SAMPLE = 3
#: Bytes of a view that is looked at by itself, for each splat that it may draw and each pixel.
_DRAWN, _TARGET = 104, 12
#: So many are added there for each given one, whether they fit or not.
_ANYWAY = 1 / 2
#: By how much the others may take more; and how much more, where views of a part share its splats.
_MARGIN, _MARGIN_OF_PARTS = 1.1, 1.6


def room_for(added: Sequence[Camera], state: State, bench: Workbench) -> int:
    """How many of some views fit, on the average, beside those of a state.

    Args:
        added: the views that might be added.
        state: its views come first.
        bench: of the stage that asks; its memory is what there is.

    Raises:
        DeviceError: the device fails, or has too little memory for one view.
    """
    if not added:
        return 0
    budget = default_memory(bench.opened) if bench.memory is None else bench.memory
    pixels = sum(view.width * view.height for view in (*state.views, *added))
    if budget > _SPLAT * len(state.source) * (len(state.views) + len(added)) + _PIXEL * pixels:
        return len(added)
    sampled = _evenly(state.views, _SAMPLE), _evenly(added, _SAMPLE)
    if seen_part(state.source, state.views) <= MOST_SEEN:
        if _by_view(state, bench):
            own, more = (_nbytes_by_view(state, views) for views in (state.views, added))
            room = int(max((budget - own * len(state.views)) // more, _ANYWAY * len(state.views)))
            return min(room, len(added))
        own, more = (_nbytes_of_parts(state, bench, views) for views in sampled)
        # Views in hand take room too, and parts are larger than what a view sees of them.
        left, margin = budget - min(SCENES * budget, state.source.nbytes) - 2 * max(own, more), _MARGIN_OF_PARTS
    else:
        own, more = (_nbytes(bench, bench.drawable(state.source), views) for views in sampled)
        left, margin = budget, _MARGIN
    left -= margin * own * len(state.views)
    return int(min(max(left // (margin * more), 0), len(added)))


def _by_view(state: State, bench: Workbench) -> bool:
    """Whether views that do not fit are made again in batches."""
    shared = bench.pool is None or bench.pool.in_process
    return shared and bench.opened.family == "gpu" and fits_whole(bench.opened, bench.drawable(state.source))


def _nbytes_by_view(state: State, views: Sequence[Camera]) -> float:
    """Bytes that is kept of a view where each is looked at by itself: about the mean."""
    pixels = sum(view.width * view.height for view in views) / len(views)
    return _DRAWN * seen_part(state.source, views) * len(state.source) + _TARGET * pixels


def _evenly(views: Sequence[Camera], count: int) -> list[Camera]:
    """So many of some views at most, from the first to the last."""
    return [views[round(place)] for place in np.linspace(0, len(views) - 1, min(count, len(views)))]


def _nbytes_of_parts(state: State, bench: Workbench, views: Sequence[Camera]) -> float:
    """Bytes that is kept of a view where it is looked at with what it may draw and no more: the mean of some."""
    source = state.source
    with thread_pool(bench.threads) as pool:
        sights = Visibility.of(source, views, INRIA.near, groups_of_large(source, pool.map), pool.map)
    held = [
        _nbytes(bench, source.subset(sights.groups.splats(seen)), [view])
        for view, seen in zip(views, sights.seen, strict=True)
        if seen.any()
    ]
    return float(np.mean(held)) if held else 1.0


def _nbytes(bench: Workbench, scene: Drawable, views: Sequence[Camera]) -> float:
    """Bytes that is kept of a view while splats are removed: the mean of some."""
    with Rasterizer(bench.opened, scene, background=bench.background) as rasterizer:
        with ExitStack() as prepared, rasterizer.preparing_many():
            for number, view in enumerate(views):
                own = PreparedSet(rasterizer, [number], rasterizer.prepare_set([view]))
                prepared.enter_context(own)
            held = rasterizer.device.allocated
        # What the rasterizer works with is there before and after.
        return (held - rasterizer.device.allocated) / len(views)
