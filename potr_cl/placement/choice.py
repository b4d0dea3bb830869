"""Which of many views to take."""

from __future__ import annotations

import heapq
from collections import deque

import numpy as np

from potr_cl.placement.candidates import AIMS, BINS, Candidates

#: A target that so many views show well is worth half of what it is at first.
_ENOUGH = 4.0
#: What a view counts from inside a room: it shows less than one from outside, and people stand there.
_INDOORS = 1.5
#: Where this part of the places is enclosed, this part of the views judge from there.
_ROOMS, _JUDGE_ROOMS = 0.15, 0.75
#: A view that shows less than this part of what the median one shows judges nothing.
_PLAIN = 0.5


def pick(candidates: Candidates, count: int) -> list[int]:
    """Greedily, by what each view adds: what few views have shown, and what none has shown from there."""
    targets = int(candidates.shown.max(initial=-1)) + 1
    from_there, at_all = np.zeros(BINS * targets, np.float32), np.zeros(targets, np.float32)
    places = candidates.shown * BINS + candidates.bins

    def gain(view: int) -> float:
        part = candidates.parts[view]
        had = (1 + from_there[places[part]]) * (1 + at_all[candidates.shown[part]] / _ENOUGH)
        worth = float((candidates.worth[part] / had).sum(dtype=np.float64))
        return worth * _INDOORS if candidates.enclosed[view] else worth

    # Gains only fall, so an old one bounds the new one from above.
    heap = [(-gain(view), view) for view in range(len(candidates.parts))]
    heapq.heapify(heap)
    picked: list[int] = []
    while heap and len(picked) < count:
        _, view = heapq.heappop(heap)
        now = gain(view)
        if heap and now < -heap[0][0]:
            heapq.heappush(heap, (-now, view))
            continue
        picked.append(view)
        part = candidates.parts[view]
        from_there[places[part]] += candidates.worth[part]
        at_all[candidates.shown[part]] += candidates.worth[part]
    return picked


def drawn(candidates: Candidates, count: int) -> list[int]:
    """Views that judge, one at a place: wherever somebody could stand, not where most is to be seen, but for those that
    show little. Where there are rooms, most of them stand in rooms."""
    worth = np.array([candidates.worth[part].sum() for part in candidates.parts])
    seen = worth[worth > 0]
    plain = (worth >= _PLAIN * np.median(seen) if len(seen) else np.ones(len(worth), bool)).reshape(AIMS, -1)
    places = plain.shape[1]
    rooms = bool(np.count_nonzero(candidates.enclosed[:places]) >= _ROOMS * places)
    waiting: dict[bool, deque[int]] = {True: deque(), False: deque()}
    for place in range(places):
        good = [aim for aim in ((place + turn) % AIMS for turn in range(AIMS)) if plain[aim, place]]
        if good:
            waiting[rooms and bool(candidates.enclosed[place])].append(good[0] * places + place)
    found: list[int] = []
    indoors = 0
    while len(found) < count and (waiting[True] or waiting[False]):
        inside = indoors < _JUDGE_ROOMS * (len(found) + 1)
        inside = inside if waiting[inside] else not inside
        found.append(waiting[inside].popleft())
        indoors += inside
    return found
