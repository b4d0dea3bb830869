"""Which levels of detail a viewer shows for a budget of splats: as PlayCanvas' engine chooses (:data:`CHOICES`).

Both walk from the coarsest level of all leaves upwards, the most urgent upgrade first, and stop at the first that the
budget has no room for. Leaves behind the camera are shown, too.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Mapping
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene

Levels: TypeAlias = NDArray[np.int64]

#: The tangent of half the field of view that the engine compares others with.
_REFERENCE = math.tan(math.radians(22.5))
#: By distance, the engine's defaults: a level is for distances so much larger than the one before; what is right behind
#: the camera counts as so much farther away; so much of a leaf's extent beyond the median leaf's does not count.
_MULTIPLIER, _BEHIND, _SHRINK, _BASE = 3.0, 1.5, 0.75, 5.0
#: Logarithms of distances are sorted into bins and parts of them; what shares a part is upgraded together.
_BINS, _PARTS, _SPAN = 1024, 1024, 96


class Levelled(Protocol):
    """A scene in levels of detail, cut into leaves.

    Attributes:
        boxes: (leaves, 6) float64 x0, y0, z0, x1, y1, z1, world units.
        counts: (leaves, levels) int64 splats, the finest level first; 0 where a leaf lacks a level.
        errors: (leaves, levels) float64, what each level loses; None if nobody has measured it.
    """

    boxes: NDArray[np.float64]
    counts: NDArray[np.int64]
    errors: NDArray[np.float64] | None

    def shown(self, levels: Levels) -> Scene:
        """The scene of which each leaf shows its own level, (leaves,), or nothing (-1)."""
        ...


def by_distance(scene: Levelled, view: Camera, budget: int) -> Levels:
    """Near leaves first: the engine's only way since 2.23, its usual one before.

    Args:
        scene: in levels.
        view: to look from.
        budget: splats.

    Returns:
        (leaves,) the level of each leaf; -1 shows nothing.
    """
    bands = _bands(scene.counts)
    rows = np.arange(len(bands))[:, None]
    counts = np.where(bands < 0, 0, scene.counts[rows, bands])
    last = bands.shape[1] - 1
    if counts[:, last].sum() >= budget:
        return bands[:, last]
    if counts[:, 0].sum() <= budget:
        return bands[:, 0]
    step = math.log(_MULTIPLIER) * _BINS / _SPAN
    places = (np.log(_distances(view, scene.boxes) / _BASE) + _SPAN / 2) * _BINS / _SPAN + step
    places = np.clip((places[:, None] - step * np.arange(1, last + 1)) * _PARTS, 0, _BINS * _PARTS - 1).astype(np.int64)
    urgencies, upgrades = np.unique(places, return_inverse=True)
    added = np.bincount(upgrades.ravel(), (counts[:, :-1] - counts[:, 1:]).ravel(), len(urgencies))
    over = counts[:, last].sum() + np.cumsum(added) > budget
    cut = urgencies[over.argmax()] if over.any() else _BINS * _PARTS
    # A leaf stays at the coarsest band whose upgrade there is no room for.
    stays = np.column_stack([np.ones(len(places), bool), places >= cut])
    chosen: Levels = bands[rows[:, 0], last - stays[:, ::-1].argmax(axis=1)]
    return chosen


def by_errors(scene: Levelled, view: Camera, budget: int) -> Levels:
    """By coverage times error removed for each splat added, as the engine can up to 2.22.

    Args and returns: as of :func:`by_distance`; the scene has errors.
    """
    assert scene.errors is not None
    chains = [_chain(counts, errors) for counts, errors in zip(scene.counts, scene.errors, strict=True)]
    chosen = np.array([chain[0][0] if chain else -1 for chain in chains], np.int64)
    covered = coverage(view, scene.boxes)
    waiting: list[tuple[float, int, int, int]] = []
    spent = int(sum(scene.counts[leaf, level] for leaf, level in enumerate(chosen) if level >= 0))
    order = 0
    for leaf, chain in enumerate(chains):
        if len(chain) > 1:
            waiting.append((-covered[leaf] * chain[1][1], order, leaf, 1))
            order += 1
    heapq.heapify(waiting)
    while waiting:
        urgency, _, leaf, place = heapq.heappop(waiting)
        level = chains[leaf][place][0]
        spent += int(scene.counts[leaf, level] - (scene.counts[leaf, chosen[leaf]] if chosen[leaf] >= 0 else 0))
        if spent > budget:
            break
        chosen[leaf] = level
        if place + 1 < len(chains[leaf]):
            # Never before what came before it.
            following = max(urgency, -covered[leaf] * chains[leaf][place + 1][1])
            heapq.heappush(waiting, (following, order, leaf, place + 1))
            order += 1
    return chosen


#: By the names that tables have for them.
CHOICES: Mapping[str, Callable[[Levelled, Camera, int], Levels]] = {"distance": by_distance, "errors": by_errors}


def coverage(view: Camera, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(leaves,) how much leaves count in a view by the engine's rule: (r / (r + d))², r half of a box's diagonal."""
    radii = np.linalg.norm(boxes[:, 3:] - boxes[:, :3], axis=1) / 2
    distances = np.linalg.norm(_nearest(view, boxes), axis=1) * _field(view)
    found: NDArray[np.float64] = np.maximum(np.square(radii / np.maximum(radii + distances, 1e-12)), 1e-12)
    return found


def _nearest(view: Camera, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(leaves, 3) from the camera to the nearest point of each box."""
    return np.clip(view.centre, boxes[:, :3], boxes[:, 3:]) - view.centre


def _field(view: Camera) -> float:
    """By how much farther away things are than they would be at the engine's usual field of view."""
    return min(view.width / view.fx, view.height / view.fy) / 2 / _REFERENCE


def _distances(view: Camera, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(leaves,) how far away leaves count as."""
    low, high = boxes[:, :3], boxes[:, 3:]
    half = (high - low) / 2
    off = _SHRINK * np.maximum(half - np.sort(half, axis=0)[len(half) // 2], 0)
    towards = _nearest(view, np.concatenate([low + off, high - off], axis=1))
    away = np.linalg.norm(towards, axis=1)
    ahead = towards @ view.rotation[2] / np.maximum(away, 1e-12)
    away *= np.where(away > 1e-2, 1 + np.maximum(-ahead, 0) * (_BEHIND - 1), 1)
    found: NDArray[np.float64] = np.maximum(away * _field(view), 1e-6)
    return found


def _bands(counts: NDArray[np.int64]) -> Levels:
    """(leaves, levels) which level a leaf shows where one is wanted: a finer one for one that it lacks, else a coarser.

    Nothing (-1) beyond its coarsest.
    """
    bands = np.full(counts.shape, -1, np.int64)
    for own, row in zip(counts, bands, strict=True):
        there = np.flatnonzero(own > 0)
        for level in range(there[-1] + 1 if len(there) else 0):
            finer = there[there <= level]
            row[level] = finer[-1] if len(finer) else there[0]
    return bands


def _chain(counts: NDArray[np.int64], errors: NDArray[np.float64]) -> list[tuple[int, float]]:
    """The levels of a leaf that are worth showing, the coarsest first; each with the error that a splat removes."""
    there = [level for level in range(len(counts)) if counts[level] > 0]
    if not there:
        return []
    lost = {level: float(errors[level]) for level in there}
    splats = {level: int(counts[level]) for level in there}
    if there[-1] < len(counts) - 1:  # it may show nothing
        step = lost[there[-1]] - lost[there[-2]] if len(there) > 1 else 0.0
        lost[-1], splats[-1] = lost[there[-1]] + (step if step > 0 else math.log(2)), 0
    levels: list[int] = []
    for level in sorted(lost, key=lambda level: (splats[level], lost[level])):
        if not levels or lost[level] < lost[levels[-1]]:
            levels.append(level)
    chain = [(levels[0], 0.0)]
    for place in range(1, len(levels)):
        before = levels[place - 1]
        ratios = [(lost[before] - lost[k]) / (splats[k] - splats[before]) for k in levels[place:]]
        chain.append((levels[place], max(ratios)))
    return chain
