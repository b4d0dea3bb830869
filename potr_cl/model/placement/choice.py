"""Which of many views to take: one after the other, the one that adds most."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.placement.candidates import BINS, Candidates

F32 = NDArray[np.float32]

#: Part of the views that must be enclosed by matter for the scene to count as having an inside.
_FEW = 0.05


def pick(candidates: Candidates, count: int) -> list[int]:
    """Greedily, by what each view adds.

    From outside, a room shows more than from inside. Where the colours do not tell which of the two it was made for,
    half of the views are inside whatever has one.
    """
    seen = np.zeros((candidates.worth.shape[1], BINS), np.float32)
    inside = np.flatnonzero(candidates.enclosed)
    picked: list[int] = []
    if not candidates.trained and _FEW * len(candidates.enclosed) < len(inside) < len(candidates.enclosed):
        picked = _pick_among(inside, candidates, count // 2, seen)
    rest = np.setdiff1d(np.arange(len(candidates.enclosed)), picked)
    return picked + _pick_among(rest, candidates, count - len(picked), seen)


def _pick_among(views: NDArray[np.int64], candidates: Candidates, count: int, seen: F32) -> list[int]:
    """At most ``count`` of the views; notes in ``seen`` (K, bins) what they show."""
    targets = np.arange(len(seen))
    flat, rows, new = seen.reshape(-1), targets * seen.shape[1], np.ones(len(seen), np.float32)

    def gain(view: int) -> float:
        return float(candidates.worth[view] @ (1 / (1 + flat.take(rows + candidates.bins[view]))))

    # Gains only fall, so an old one bounds the new one from above.
    first = gain if seen.any() else lambda view: float(candidates.worth[view] @ new)
    heap = [(-first(view), view) for view in views.tolist()]
    heapq.heapify(heap)
    picked: list[int] = []
    while heap and len(picked) < count:
        _, view = heapq.heappop(heap)
        now = gain(view)
        if heap and now < -heap[0][0]:
            heapq.heappush(heap, (-now, view))
            continue
        picked.append(view)
        seen[targets, candidates.bins[view]] += candidates.worth[view]
    return picked
