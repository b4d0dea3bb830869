"""How fast the workers of a work are, and when one is so slow that others had better do its part: :class:`Pace`.

A part is moved once the others have waited for it as long as it takes them to do it again from the beginning. So what a
worker costs that becomes slow is at most about twice what it would have cost to know it before, as with skis that one
may rent or buy (Karlin, Manasse, Rudolph, Sleator: Competitive snoopy caching, Algorithmica 3, 1988).
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from statistics import median
from typing import Any

from potr_cl.workers.pool import Worker

#: A worker is slow if it takes so many times as long as all would take with its views done by the others.
_SLOW = 1.5
#: Seconds that are waited for a slow worker in any case; and while parts are made, or have done nothing yet: one that
#: has not built its kernels yet looks slow.
_AT_LEAST, _AT_FIRST = 2.0, 30.0


class Round:
    """A command that several parts are at.

    Args:
        futures: what each of them will return, by its place.

    Attributes:
        began: when they were given it, by the monotonic clock.
    """

    def __init__(self, futures: Mapping[int, Future[Any]]) -> None:
        self.futures = dict(futures)
        self.began = time.monotonic()
        self._took: dict[int, float] = {}
        for place, future in futures.items():
            future.add_done_callback(partial(self._note, place))

    def _note(self, place: int, _done: Future[Any]) -> None:
        self._took[place] = time.monotonic() - self.began

    def seconds(self) -> dict[int, float]:
        """What it took those that are done, by place, without those that others do."""
        return {place: self._took[place] for place in sorted(self._took.keys() & self.futures.keys())}

    def so_far(self, place: int) -> float:
        """The seconds that one has been or was at it."""
        return self._took.get(place, time.monotonic() - self.began)


class Pace:
    """What has been seen of the workers of one work."""

    def __init__(self) -> None:
        self._work: dict[str, float] = {}  # views times commands, by worker
        self._busy: dict[str, float] = {}  # seconds that these took
        self._left: list[tuple[Worker, float, Round, int]] = []  # what slow workers are still at
        self._waited: dict[int, float] = {}  # seconds that all others have waited for a part
        self._making = 0.0  # seconds that it takes to make a part
        self._telling: list[float] = []  # and to have it do what is in the log
        self._commands = 0

    def slow_at(self, at: Round, since: float) -> float | None:
        """When the parts that are not done yet had better be done by others.

        Args:
            at: what all are at.
            since: when the master began to wait.

        Returns:
            A time of the monotonic clock; None if nobody can tell, as few are done.
        """
        took = at.seconds()
        waiting = at.futures.keys() - took.keys()
        if not waiting or len(waiting) > len(took):
            return None
        without = median(took.values()) * len(at.futures) / len(took)
        again = (self._making + sum(self._telling)) * len(waiting) / len(took)
        least = max(_AT_LEAST if self._commands else _AT_FIRST, again)
        waited = max(self._waited.get(place, 0.0) for place in waiting)
        return max(at.began + _SLOW * without, max(since, at.began + max(took.values())) + least - waited)

    def note_made(self, at: Round) -> None:
        """Parts have been made."""
        if took := at.seconds():
            self._making = median(took.values())

    def note(self, at: Round, since: float, logged: bool, by: Sequence[Worker | None], views: Sequence[float]) -> None:
        """A command has been done.

        Args:
            at: the command.
            since: when the master began to wait.
            logged: whether parts that are made again are told it.
            by: who did it, by place.
            views: how many each had, by place.
        """
        took = at.seconds()
        if not took:
            return
        usual = median(took.values())
        self._commands += 1
        if logged:
            self._telling.append(usual)
        last = max(took, key=lambda place: took[place])
        others = [seconds for place, seconds in took.items() if place != last]
        slow = bool(others) and took[last] > _SLOW * median(others) * len(took) / len(others)
        # One that something else has kept busy for a moment is forgiven when it has kept up as long.
        for place, waited in self._waited.items():
            if place != last or not slow:
                self._waited[place] = max(waited - usual, 0.0)
        if slow:
            waited = at.began + took[last] - max(since, at.began + max(others))
            self._waited[last] = self._waited.get(last, 0.0) + max(waited, 0.0)
        work: dict[str, float] = {}
        busy: dict[str, float] = {}
        for place, seconds in took.items():
            worker = by[place]
            if worker is not None and place < len(views):
                # Of several parts that a worker has, each waits for the others.
                work[worker.name] = work.get(worker.name, 0.0) + views[place]
                busy[worker.name] = max(busy.get(worker.name, 0.0), seconds)
        for name, done in work.items():
            self._add(name, done, busy[name])

    def forget_log(self) -> None:
        """Parts that are made again are told nothing of what was before."""
        self._telling.clear()

    def leave(self, worker: Worker, views: float, at: Round, place: int) -> None:
        """Others do what a worker is at, which therefore is no longer waited for."""
        self._left.append((worker, views, at, place))
        worker.behind = at.futures.pop(place)

    def rate(self, workers: Collection[Worker]) -> None:
        """Note how fast these workers are, and those that were not waited for."""
        named = {worker.name: worker for worker in workers}
        for worker, views, at, place in self._left:
            named[worker.name] = worker
            self._add(worker.name, views, at.so_far(place))
        self._left.clear()
        for name, worker in named.items():
            if self._work.get(name, 0.0) > 0 and self._busy[name] > 0:
                worker.rate = self._work[name] / self._busy[name]

    def _add(self, name: str, views: float, seconds: float) -> None:
        self._work[name] = self._work.get(name, 0.0) + views
        self._busy[name] = self._busy.get(name, 0.0) + seconds
