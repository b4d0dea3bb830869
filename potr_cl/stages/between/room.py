"""How many added views fit the memory that views may fill (:func:`room_for`).

A view that does not fit is made again for each measurement. So added views that take the room of others cost many times
what they should, and only as many are added as there is room for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.prepared_views import PreparedViews
from potr_cl.stages.pruning.sweep_options import default_memory
from potr_cl.stages.stage import State, Workbench

#: More bytes than a view takes, for each splat and each pixel: where there are so many, nothing has to be measured.
_SPLAT, _PIXEL = 500, 200
#: Views whose memory is measured.
_SAMPLE = 3
#: Bytes that are enough for them.
_PLENTY = 1e18
#: By how much the others may take more.
_MARGIN = 1.1


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
    with Rasterizer(bench.opened, bench.drawable(state.source), background=bench.background) as rasterizer:
        own, more = (_nbytes(rasterizer, views) for views in (state.views, added))
    left = budget - _MARGIN * own * len(state.views)
    return int(min(max(left // (_MARGIN * more), 0), len(added)))


def _nbytes(rasterizer: Rasterizer, views: Sequence[Camera]) -> float:
    """Bytes that is kept of a view while splats are removed: the mean of a few."""
    chosen = [views[round(place)] for place in np.linspace(0, len(views) - 1, min(_SAMPLE, len(views)))]
    with PreparedViews(rasterizer, chosen, _PLENTY, 1):
        held = rasterizer.device.allocated
    # What the rasterizer works with is there before and after.
    return (held - rasterizer.device.allocated) / len(chosen)
