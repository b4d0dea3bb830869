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
        names: of the workers that the parts are meant for, in the same order.
    """

    own: list[int]
    others: list[list[int]]
    names: tuple[str, ...] = ()


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
    speeds = [*([own_speed] if pool.takes_part else []), *[1.0] * len(workers)]
    dealt: list[list[int]] = [[] for _ in speeds]
    for part in range(parts):
        numbers = range(part, views, parts)
        for share, places in zip(dealt, deal(len(numbers), speeds, part), strict=True):
            share += [numbers[place] for place in places]
    own, others = (dealt[0], dealt[1:]) if pool.takes_part else ([], dealt)
    busy = [(worker, sorted(each)) for worker, each in zip(workers, others, strict=True) if each]
    return Shares(sorted(own), [each for _, each in busy], tuple(worker.name for worker, _ in busy))


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
