"""How views are shared out: :func:`shares`. Sums over views do not depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from potr_cl.workers.pool import Pool


@dataclass(frozen=True)
class Shares:
    """Who does which views.

    Attributes:
        own: numbers of the master's views. others: of each part's; none is empty.
    """

    own: list[int]
    others: list[list[int]]


def shares(pool: Pool, views: int) -> Shares:
    """Share so many views out to a pool.

    Raises:
        WorkerLost: no worker is left.
    """
    speeds = [worker.speed for worker in pool.workers()]
    if not pool.takes_part:
        return Shares([], [each for each in deal(views, speeds) if each])
    own, *others = deal(views, [1.0, *speeds])
    return Shares(own, [each for each in others if each])


def deal(views: int, speeds: Sequence[float]) -> list[list[int]]:
    """Numbers of views for each of several workers, ascending, in proportion to their speeds.

    Neighbours go to different workers: views that lie near each other take about the same time. A worker gets none
    where there are fewer views than workers.

    Args:
        views: how many there are.
        speeds: of the workers, above 0.
    """
    shares: list[list[int]] = [[] for _ in speeds]
    for view in range(views):
        # The first of those that would be done earliest.
        best = min(range(len(speeds)), key=lambda place: (len(shares[place]) + 1) / speeds[place])
        shares[best].append(view)
    return shares
