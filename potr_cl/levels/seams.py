"""From where a level may be shown in place of the next finer one, so that nobody sees the change: :func:`scales_shown`.

Not always from far enough away: classic scenes' splats are widened by the rasterizer's low pass, and the more so in
small pictures, where the finer level then has more matter than the coarser one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack

import numpy as np

from potr_cl.levels.plan import scale_of_level, scaled
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.quality.judging import Judging, Looks
from potr_cl.raster.scene_buffers import uploaded

#: Pictures of two levels that are as near, decibels, nobody tells from each other at a glance.
SEAM = 40.0
#: Where no scale is enough, decibels less than the best one's are as good.
_ABOUT = 1.0
#: Scales of pictures that are tried for a level, each smaller by this factor, and how many.
_FACTOR, _TRIED = 2**-0.25, 9
#: Decibels that identical pictures count as.
_SAME = 120.0
#: Views to compare them in, spread evenly.
_VIEWS = 8


def scales_shown(
    device: Device,
    scenes: Callable[[int], Scene],
    levels: int,
    views: Sequence[Camera],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[float]:
    """By how much smaller each level's pictures have to be than those of the finest one.

    Args:
        device: to render on.
        scenes: gives a level's scene, as readers see it.
        levels: how many there are.
        views: to look from, at full size.
        background: R, G, B behind the scene.

    Returns:
        For each level, the largest scale that is tried, from that for which it was made, in which its pictures and
        those of the level before are SEAM apart or nearer; where there is none, in which they are about as near as in
        any.
    """
    some = [views[k] for k in np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(int)]
    found = [1.0]
    with ExitStack() as stack:
        finer = stack.enter_context(uploaded(device, scenes(0)))
        for level in range(1, levels):
            coarser = stack.enter_context(uploaded(device, scenes(level)))
            tried = [min(scale_of_level(level), found[-1]) * _FACTOR**k for k in range(_TRIED)]
            near: list[float] = []
            while len(near) < len(tried) and max(near, default=0.0) < SEAM:
                with Judging(device, finer, scaled(some, tried[len(near)]), Looks(background)) as judging:
                    views_there = judging.figures(coarser)
                near.append(float(np.mean([min(view.figures["b_against_a"].psnr, _SAME) for view in views_there])))
            enough = min(SEAM, max(near) - _ABOUT)
            found.append(next(scale for scale, decibels in zip(tried, near, strict=False) if decibels >= enough))
            finer.close()
            finer = coarser
    return found
