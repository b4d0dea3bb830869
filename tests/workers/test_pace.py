"""When a slow worker's views had better be done by others, and what is noted of its speed; by a clock of the test."""

from __future__ import annotations

from concurrent.futures import Future
from types import SimpleNamespace

import pytest

from potr_cl.workers import pace
from potr_cl.workers.dealing import shares
from potr_cl.workers.pace import Pace, Round
from potr_cl.workers.pool import Worker


class Named(Worker):
    def __init__(self, name: str) -> None:
        self.name = name

    def make(self, kind, memory, given):
        raise NotImplementedError


class Workers:
    """Workers that are told one thing after the other, and each time take as long as is said.

    Attributes:
        now: seconds.
    """

    takes_part = False

    def __init__(self, names: str, views: float = 4.0) -> None:
        self.now = 0.0
        self.views = [views] * len(names)
        self.pace = Pace()
        self._workers = [Named(name) for name in names]

    def workers(self) -> list[Named]:
        return self._workers

    def told(self, *seconds: float, made: bool = False, moves: bool = True) -> float | None:
        """Have each take so long. The seconds after which the last one's part is moved, if it is and may be."""
        futures: dict[int, Future[None]] = {place: Future() for place in range(len(seconds))}
        began, at = self.now, Round(futures)
        for place in sorted(futures, key=lambda place: seconds[place]):
            limit = self.pace.slow_at(at, began) if moves else None
            if limit is not None and limit < began + seconds[place]:
                self.now = max(limit, self.now)
                self.pace.leave(self._workers[place], self.views[place], at, place)
                return self.now - began
            self.now = began + seconds[place]
            futures[place].set_result(None)
        if made:
            self.pace.note_made(at)
        else:
            self.pace.note(at, began, True, self._workers, self.views)
        return None


@pytest.fixture
def workers(monkeypatch):
    def of(names: str, views: float = 4.0) -> Workers:
        found = Workers(names, views)
        monkeypatch.setattr(pace, "time", SimpleNamespace(monotonic=lambda: found.now))
        return found

    return of


def test_workers_that_are_all_as_slow_keep_their_views(workers):
    some = workers("abc")
    assert some.told(3, 2, 3, made=True) is None
    assert [some.told(1.2, 0.8, 1.2) for _ in range(50)] == [None] * 50


@pytest.mark.parametrize("others", [1, 2])
def test_a_slow_one_is_waited_for_no_longer_than_it_takes_to_do_its_part_again(workers, others):
    some = workers("abc"[: others + 1])
    assert some.told(*[1.0] * others, 1.0, made=True) is None
    for _ in range(20):
        assert some.told(*[1.0] * others, 1.0) is None
    again = (1.0 + 20 * 1.0) / others
    assert some.told(*[1.0] * others, 1000.0) == pytest.approx(1.0 + max(again, 0.5 * (others + 1) / others))


def test_who_is_a_little_late_all_the_time_is_moved_in_the_end(workers):
    """What it has had the others wait for is added up, to as much as it takes to do it again."""
    some = workers("ab")
    some.told(1.0, 1.0, made=True)
    waited, number, moved = 0.0, 0, some.told(1.0, 4.0)
    while moved is None and number < 100:
        waited, number, moved = waited + 3.0, number + 1, some.told(1.0, 4.0)
    # The log grows meanwhile, by what a command usually takes.
    assert moved is not None
    assert number > 0
    waited += moved - 1.0
    made_again = 1.0 + 2.5 * number
    assert made_again - 3.0 <= waited <= made_again + 3.0


def test_one_that_is_late_now_and_then_is_forgiven(workers):
    some = workers("abc")
    some.told(0.3, 0.3, 0.3, made=True)
    seconds = [(0.3, 2.1 if number % 8 == 4 else 0.3, 0.3) for number in range(400)]
    assert not [each for each in map(lambda each: some.told(*each), seconds) if each is not None]


def test_at_first_little_is_known(workers):
    """A worker that has not built its kernels yet looks slow."""
    assert workers("ab").told(1.0, 29.0) is None
    assert workers("ab").told(1.0, 1000.0) == pytest.approx(1.0 + 30.0)


def test_slow_workers_get_fewer_views(workers):
    """From the second work on: how fast they are shows in the first one."""
    some = workers("ab", views=15)
    assert [len(each) for each in shares(some, 30).others] == [15, 15]
    for _ in range(5):
        some.told(0.3, 1.2, moves=False)
    some.pace.rate(some.workers())
    assert [len(each) for each in shares(some, 30).others] == [24, 6]


def test_a_slow_worker_that_is_left_is_counted_by_what_it_is_still_at(workers):
    some = workers("abc", views=4)
    some.told(1.0, 1.0, 1.0, made=True)
    some.told(1.0, 1.0, 1.0)
    moved = some.told(1.0, 1.0, 1000.0)
    assert moved is not None
    some.now += 38.0
    some.pace.rate(some.workers())
    rates = [worker.rate for worker in some.workers()]
    assert rates == [4.0, 4.0, pytest.approx(8 / (1.0 + moved + 38.0))]
    share = shares(some, 34)
    counts = dict(zip(share.names, map(len, share.others), strict=True))
    assert counts.get("c", 0) <= 4
    assert counts["a"] + counts["b"] >= 30
