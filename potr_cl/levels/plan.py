"""How many splats each level of detail has, and at which resolution it is looked at."""

from __future__ import annotations

from collections.abc import Sequence

from potr_cl.model.camera import Camera, resized

#: Each level has this part of the splats of the one before.
HALVING = 0.5
#: Where nobody says how many levels: as many until one has fewer splats than this, and no more of them than that.
FEWEST_SPLATS, MOST_BY_ITSELF = 30_000, 6


def counts_of_levels(splats: int, levels: int | str) -> list[int]:
    """How many splats each level is to have, the finest first; no two have the same number.

    Args:
        splats: of the finest level.
        levels: how many of them, or "auto".
    """
    counts = [splats]
    most = MOST_BY_ITSELF if isinstance(levels, str) else levels
    while len(counts) < most and counts[-1] > 1:
        if levels == "auto" and counts[-1] < FEWEST_SPLATS:
            break
        counts.append(max(round(splats * HALVING ** len(counts)), 1))
    return counts


def scale_of_level(level: int) -> float:
    """By how much smaller pictures are for which a level is made: half the splats for half the pixels."""
    return float(HALVING ** (level / 2))


def views_of_level(cameras: Sequence[Camera], level: int) -> list[Camera]:
    """The same views in as many pixels as they have where a level is to be shown."""
    return scaled(cameras, scale_of_level(level))


def scaled(cameras: Sequence[Camera], scale: float) -> list[Camera]:
    """The same views in smaller pictures."""
    if scale == 1:
        return list(cameras)
    return [resized(view, max(round(view.width * scale), 1), max(round(view.height * scale), 1)) for view in cameras]
