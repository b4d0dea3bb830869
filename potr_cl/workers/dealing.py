"""How views are shared out: :func:`shares`. Sums over views do not depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from potr_cl.workers.pool import Pool, Worker

#: A worker that is slower than this against another one gets fewer views.
_MATTERS = 1.25


@dataclass(frozen=True)
class Shares:
    """Who does which views.

    Attributes:
        own: numbers of the master's views. others: of each part's; none is empty.
    """

    own: list[int]
    others: list[list[int]]


def shares(pool: Pool, views: int, parts: int = 1, own_speed: float = 1.0) -> Shares:
    """Share so many views out to a pool.

    Args:
        pool: the workers.
        views: how many there are.
        parts: view k belongs to part k modulo this: each part alone is shared out in the same way.
        own_speed: of the master against a worker, if it takes part.

    Raises:
        WorkerLost: no worker is left.
    """
    workers = pool.workers()
    speeds = [1.0] * len(workers) if pool.takes_part else speeds_of(workers)
    speeds = [own_speed, *speeds] if pool.takes_part else speeds
    dealt: list[list[int]] = [[] for _ in speeds]
    for part in range(parts):
        numbers = range(part, views, parts)
        for share, places in zip(dealt, deal(len(numbers), speeds, part), strict=True):
            share += [numbers[place] for place in places]
    own, others = (dealt[0], dealt[1:]) if pool.takes_part else ([], dealt)
    return Shares(sorted(own), [sorted(each) for each in others if each])


def speeds_of(workers: Sequence[Worker]) -> list[float]:
    """How fast workers are in proportion to each other, as far as that is known and matters.

    Small differences say more about what else a computer did just then than about its device.
    """
    rates = [worker.rate for worker in workers]
    known = [rate for rate in rates if rate is not None]
    if len(known) < len(rates) or not known or max(known) < _MATTERS * min(known):
        return [1.0] * len(rates)
    return [rate / max(known) for rate in known]


def deal(views: int, speeds: Sequence[float], first: int = 0) -> list[list[int]]:
    """Numbers of views for each of several workers, ascending, in proportion to their speeds.

    Neighbours go to different workers: views that lie near each other take about the same time. A worker gets none
    where there are fewer views than workers.

    Args:
        views: how many there are.
        speeds: of the workers, above 0.
        first: number of the worker, modulo how many they are, who is asked first: it gets what is left over.
    """
    shares: list[list[int]] = [[] for _ in speeds]
    for view in range(views):
        # The first of those that would be done earliest.
        asked = ((first + turn) % len(speeds) for turn in range(len(speeds)))
        best = min(asked, key=lambda place: (len(shares[place]) + 1) / speeds[place])
        shares[best].append(view)
    return shares
