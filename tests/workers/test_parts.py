"""Parts that are lost on the way are made again elsewhere, and nobody sees it in the results."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from potr_cl.errors import DeviceMemoryError, UsageError
from potr_cl.workers.parts import Each, Parts
from potr_cl.workers.pool import Held, Part, Pool, Shared, Traffic, Worker, WorkerLost

#: Seconds that a worker may be silent: they are waited in vain here, and enough for those that are only kept busy.
PATIENCE = 1.0


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
    assert "worker a failed" in caplog.text


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


def test_who_stands_still_in_another_work_is_not_waited_for_in_the_end(monkeypatch):
    ended = []
    monkeypatch.setattr(FakeHeld, "close", lambda held: ended.append((held.worker.name, "waited")))
    monkeypatch.setattr(FakeHeld, "abandon", lambda held: ended.append((held.worker.name, "left")), raising=False)
    still, other = FakeWorker("a"), FakeWorker("b")
    with Parts(FakePool(still, other), Sum, [(0, 1), (0, 2)]) as parts:
        assert parts.tell("add", 1) == [1, 2]
        still.lost = True
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


def test_parts_go_to_the_workers_that_they_were_meant_for():
    """Where the first worker gets none, it gets none."""
    a, b, c = (FakeWorker(name) for name in "abc")
    with Parts(FakePool(a, b, c), Sum, [(0, 1), (0, 1)], names=("b", "c")) as parts:
        parts.tell("add", 1)
    assert (a.commands, b.commands, c.commands) == (0, 1, 1)
