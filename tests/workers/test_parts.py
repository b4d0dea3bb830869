"""Parts that are lost on the way are made again elsewhere, and nobody sees it in the results."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from potr_cl.errors import DeviceMemoryError, UsageError
from potr_cl.workers import pace
from potr_cl.workers.dealing import in_pieces, shares
from potr_cl.workers.parts import Each, Parts
from potr_cl.workers.pool import Held, Part, Pool, Shared, Traffic, Worker, WorkerLost

#: Seconds that a worker may be silent: they are waited in vain here, and enough for those that are only kept busy.
PATIENCE = 2.0


class Sum(Part):
    """Adds up what it is told."""

    def __init__(self, device, memory, start, step):
        self.total = start
        self.step = step

    def add(self, number):
        self.total += number * self.step
        return self.total

    def look(self):
        return self.total

    def refuse(self):
        raise UsageError("no")

    def close(self):
        pass


class FakeWorker(Worker):
    """Loses its parts at its n-th command, by an error or by silence."""

    def __init__(self, name, lost_at=None, error=None, silent=False):
        self.name, self.lost_at, self.error, self.silent = name, lost_at, error, silent
        self.commands = 0
        self.threads = ThreadPoolExecutor(1)

    def make(self, kind, memory, given):
        def made():
            things = [each.handle if isinstance(each, Shared) else each for each in given]
            return FakeHeld(self, kind(None, memory, *things))

        return self.threads.submit(made)


class FakeHeld(Held):
    def __init__(self, worker, part):
        self.worker, self.part = worker, part

    def begin(self, command, args):
        worker = self.worker
        worker.commands += 1
        if worker.lost_at is not None and worker.commands >= worker.lost_at:
            if worker.silent:
                return Future()
            failed: Future = Future()
            failed.set_exception(worker.error or WorkerLost(f"{worker.name} is gone"))
            return failed
        return worker.threads.submit(lambda: getattr(self.part, command)(*args))

    def close(self):
        self.part.close()


class FakePool(Pool):
    takes_part = False
    sparse = False
    names = ()

    def __init__(self, *workers, patience=None):
        self._workers = list(workers)
        self.traffic = Traffic()
        self.patience = patience

    def workers(self):
        return self._workers

    @contextmanager
    def shared(self, thing):
        yield Shared(thing)

    def close(self):
        pass


def course(pool):
    """What parts say on the way, the third step being a mere question."""
    with pool.shared(10) as start, Parts(pool, Sum, [(start, 1), (start, 2), (start, 3)]) as parts:
        said = [parts.tell("add", 5), parts.tell("add", 7)]
        said.append([parts.ask(place, "look") for place in range(3)])
        said.append(parts.begin("look", logged=False).results())
        return [*said, parts.tell("add", 1)]


EXPECTED = [[15, 20, 25], [22, 34, 46], [22, 34, 46], [22, 34, 46], [23, 36, 49]]


def test_parts_do_what_they_are_told():
    assert course(FakePool(FakeWorker("a"), FakeWorker("b"))) == EXPECTED


@pytest.mark.parametrize("lost_at", range(1, 7))
@pytest.mark.parametrize("error", [None, DeviceMemoryError("too little memory")])
def test_lost_parts_are_made_again(lost_at, error, caplog):
    assert course(FakePool(FakeWorker("a", lost_at, error), FakeWorker("b"))) == EXPECTED
    assert "worker a gave up" in caplog.text


def test_several_are_lost_one_after_the_other():
    assert course(FakePool(FakeWorker("a", 3), FakeWorker("b", 9), FakeWorker("c"))) == EXPECTED


def test_all_are_lost():
    with pytest.raises(WorkerLost, match="b is gone"):
        course(FakePool(FakeWorker("a", 2), FakeWorker("b", 6)))


def test_a_silent_worker_is_given_up():
    assert course(FakePool(FakeWorker("a", 4, silent=True), FakeWorker("b"), patience=PATIENCE)) == EXPECTED


@pytest.mark.slow
def test_who_should_do_it_instead_is_silent_too():
    """Several stand still at the same time; each is waited for once."""
    workers = FakeWorker("a", 3, silent=True), FakeWorker("b", 4, silent=True), FakeWorker("c")
    assert course(FakePool(*workers, patience=PATIENCE)) == EXPECTED


def test_what_several_threads_count_is_all_counted():
    traffic = Traffic()
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda _: [traffic.add(1, 2) for _ in range(5000)], range(8)))
    assert traffic == Traffic(sent=40_000, received=80_000)


@pytest.mark.parametrize("how", ["lost", "behind"])
def test_who_stands_still_in_another_work_is_not_waited_for_in_the_end(how, monkeypatch):
    ended = []
    monkeypatch.setattr(FakeHeld, "close", lambda held: ended.append((held.worker.name, "waited")))
    monkeypatch.setattr(FakeHeld, "abandon", lambda held: ended.append((held.worker.name, "left")), raising=False)
    still, other = FakeWorker("a"), FakeWorker("b")
    with Parts(FakePool(still, other), Sum, [(0, 1), (0, 2)]) as parts:
        assert parts.tell("add", 1) == [1, 2]
        if how == "lost":
            still.lost = True
        else:
            still.behind = Future()
    assert ended == [("a", "left"), ("b", "waited")]


@pytest.mark.parametrize("lost_at", [None, 1, 2, 3, 4])
def test_parts_can_be_told_different_things(lost_at):
    """And those that are made again are told again what was theirs."""
    pool = FakePool(FakeWorker("a", lost_at), FakeWorker("b"))
    with Parts(pool, Sum, [(0, 1), (0, 2), (0, 3)]) as parts:
        assert parts.tell("add", Each([1, 10, 100])) == [1, 20, 300]
        assert parts.tell("add", 5) == [6, 30, 315]
        assert parts.tell("add", Each([7, 0, 2])) == [13, 30, 321]


def test_a_worker_that_is_silent_in_one_work_is_not_waited_for_in_another():
    a, b = FakeWorker("a", 3, silent=True), FakeWorker("b")
    pool = FakePool(a, b, patience=PATIENCE)
    with Parts(pool, Sum, [(0, 1), (0, 1)]) as first, Parts(pool, Sum, [(0, 1), (0, 1)]) as second:
        assert first.tell("add", 1) == second.tell("add", 1) == [1, 1]
        assert first.tell("add", 1) == [2, 2]
        pool.patience = 600.0
        began = time.monotonic()
        assert second.tell("add", 1) == [2, 2]
        assert time.monotonic() - began < 300
        assert a.commands == 3


def test_a_refusal_is_no_loss():
    with Parts(FakePool(FakeWorker("a"), FakeWorker("b")), Sum, [(0, 1), (0, 1)]) as parts:
        with pytest.raises(UsageError, match="no"):
            parts.tell("refuse")
        assert parts.tell("add", 2) == [2, 2]


def test_how_fast_workers_are_shows_in_their_first_work():
    """What follows from that: tests/workers/test_pace.py."""
    a, b = FakeWorker("a"), FakeWorker("b")
    with Parts(FakePool(a, b), Sum, [(0, 1), (0, 4)], views=[15, 15]) as parts:
        began = time.monotonic()
        for number in range(5):
            parts.tell("add", number)
        took = time.monotonic() - began
        assert a.rate is None
    assert a.rate is not None
    assert b.rate is not None
    assert min(a.rate, b.rate) >= 5 * 15 / took


def test_a_log_that_begins_anew_is_not_replayed_whole():
    first, second = FakeWorker("a", 12), FakeWorker("b")
    with Parts(FakePool(first, second), Sum, [(0, 1)]) as parts:
        for number in range(10):
            parts.tell("add", number)
        parts.begin("look", anew=True).results()
        assert parts.tell("look") == [0]  # made again, and told only the two last commands
    assert second.commands == 2


@pytest.mark.parametrize("in_process", [True, False])
def test_threads_forget_their_parts_meanwhile(in_process, monkeypatch):
    """The master goes on, and waits at the end; workers elsewhere are told at the end alone."""
    order, gone_on = [], threading.Event()

    def close(self):
        assert gone_on.wait(300)
        order.append("forgotten")

    monkeypatch.setattr(Sum, "close", close)
    pool = FakePool(FakeWorker("a"), FakeWorker("b"))
    pool.in_process = in_process
    with Parts(pool, Sum, [(10, 1), (10, 2)]) as parts:
        assert parts.tell("add", 1) == [11, 12]
        parts.begin_to_close()
        order.append("went on")
        gone_on.set()
    assert order == ["went on", "forgotten", "forgotten"]


class Slow(Sum):
    """Does nothing for a while on workers that stand still; views are the numbers that it multiplies by."""

    def __init__(self, device, memory, numbers):
        self.numbers = numbers
        self.total = 0
        here.wait("make")

    @classmethod
    def split(cls, given, pieces):
        (numbers,) = given
        return [(own,) for own in in_pieces(numbers, pieces)]

    def add(self, number):
        here.wait("add")
        self.total += number * sum(self.numbers)
        return self.total


here = threading.local()


class Runner(FakeWorker):
    """A worker that stands still, from its n-th "add" or "make" on, until it is let go on."""

    def __init__(self, name, adds=None, makes=None):
        super().__init__(name)
        self.go_on = threading.Event()
        self.begun = dict.fromkeys(("add", "make"), 0)
        self.still_at = {"add": adds, "make": makes}
        self.threads.submit(setattr, here, "wait", self.wait)

    def wait(self, what):
        self.begun[what] += 1
        still_at = self.still_at[what]
        if still_at is not None and self.begun[what] >= still_at:
            self.go_on.wait(300)


@pytest.fixture
def runners():
    """Workers that go on when a test ends."""
    made = []

    def of(*args, **choices):
        made.append(Runner(*args, **choices))
        return made[-1]

    yield of
    for each in made:
        each.go_on.set()


@pytest.fixture
def in_a_hurry(monkeypatch):
    """Slow workers are waited for little, but longer than those that a busy machine holds up."""
    monkeypatch.setattr(pace, "_AT_LEAST", 0.5)
    monkeypatch.setattr(pace, "_AT_FIRST", 1.5)


def relieving(*workers):
    pool = FakePool(*workers)
    pool.relieves = True
    return pool


def sums(pool, rounds, views=12):
    """What is found in each round, summed over parts."""
    share = shares(pool, views).others
    with Parts(pool, Slow, [(own,) for own in share], views=[len(own) for own in share]) as parts:
        return [sum(parts.tell("add", number)) for number in range(rounds)]


def sums_of_one(rounds):
    return sums(FakePool(Runner("one")), rounds)


@pytest.mark.parametrize("workers", [2, 3])
def test_others_do_the_views_of_a_slow_worker(workers, in_a_hurry, caplog, runners):
    """No round waits until it is done. How long it is waited for: tests/workers/test_pace.py."""
    slow = runners("slow", adds=1)
    assert sums(relieving(slow, *(runners(str(number)) for number in range(1, workers))), 8) == sums_of_one(8)
    assert slow.begun["add"] == 1
    assert slow.is_behind
    assert "worker slow is slow: its views go to 1" in caplog.text


def test_who_becomes_slow_on_the_way_and_who_is_slow_from_the_beginning(in_a_hurry, runners):
    slow = runners("b", adds=6)
    assert sums(relieving(runners("a"), slow, runners("c")), 12) == sums_of_one(12)
    assert 0 < slow.begun["add"] <= 6
    slow = runners("b", makes=1)
    assert sums(relieving(runners("a"), slow, runners("c")), 3) == sums_of_one(3)
    assert slow.begun == {"make": 1, "add": 0}


def test_a_slow_worker_gets_little_in_the_next_work(in_a_hurry, runners):
    slow = runners("slow", adds=1)
    pool = relieving(slow, runners("a"), runners("b"))
    sums(pool, 6)
    assert slow.is_behind
    # One that is still at something gets nothing; what it gets then depends on how long it was at it.
    assert slow.rate is not None
    slow.go_on.set()
    assert slow.behind is not None
    slow.behind.result(300)
    share = shares(pool, 34)
    counts = dict(zip(share.names, map(len, share.others), strict=True))
    # It did 4 views in the time in which one of the others did 4 to 6 six times.
    assert counts.get("slow", 0) <= 4
    assert counts.get("a", 0) + counts.get("b", 0) >= 30


def test_a_slow_worker_is_waited_for_where_others_cannot(in_a_hurry, runners):
    """They have no room, say; and it is asked once only."""
    slow = runners("slow", adds=1)

    class Large(Slow):
        made = 0

        def __init__(self, device, memory, numbers):
            Large.made += 1
            if Large.made > 2:
                slow.go_on.set()  # the other one has been asked
                raise DeviceMemoryError("too little memory")
            super().__init__(device, memory, numbers)

    pool = relieving(slow, runners("a"))
    with Parts(pool, Large, [([1, 2, 3],), ([4, 5],)]) as parts:
        assert [sum(parts.tell("add", 1)) for _ in range(3)] == [15, 30, 45]
    assert Large.made == 3


def test_what_a_worker_is_still_at_is_nothing_to_add_to():
    """One that others have overtaken gets no part until it is done."""
    late: Future = Future()
    worker = Runner("a")
    worker.behind = late
    assert worker.is_behind
    late.set_result(None)
    assert not worker.is_behind


def test_parts_go_to_the_workers_that_they_were_meant_for():
    """Where the first worker gets none, it gets none."""
    a, b, c = (FakeWorker(name) for name in "abc")
    a.rate, b.rate, c.rate = 0.1, 1.0, 1.0
    pool = FakePool(a, b, c)
    share = shares(pool, 2)
    assert share.names == ("b", "c")
    with Parts(pool, Sum, [(0, len(own)) for own in share.others], names=share.names) as parts:
        parts.tell("add", 1)
    assert (a.commands, b.commands, c.commands) == (0, 1, 1)
