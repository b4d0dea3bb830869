"""Threads that share a work."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future

import pytest

from potr_cl.host.threads import Ahead, SharedWork, first_error, thread_pool


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_all_tasks_are_done_once(threads):
    done = []
    work = SharedWork()
    futures = [work.add(lambda n=n: done.append(n) or n) for n in range(200)]
    with thread_pool(threads) as pool:
        for _ in range(threads):
            pool.submit(work.do)
        assert [future.result() for future in futures] == list(range(200))
    assert sorted(done) == list(range(200))


def test_tasks_are_taken_in_their_order():
    done = []
    work = SharedWork()
    for n in range(20):
        work.add(lambda n=n: done.append(n))
    work.do()
    assert done == list(range(20))


@pytest.mark.parametrize("threads", [1, 3])
def test_parts_of_a_task_come_first_and_keep_their_order(threads):
    """Also where the only thread is the one that shares them out."""
    work = SharedWork()
    whole = work.add(lambda: work.run(lambda n: n * n, range(50)))
    work.add(lambda: None)
    with thread_pool(threads) as pool:
        for _ in range(threads):
            pool.submit(work.do)
        assert whole.result(timeout=300) == [n * n for n in range(50)]


def test_parts_are_done_by_other_threads_too():
    work = SharedWork()
    seen = set()
    both = threading.Barrier(2, timeout=300)

    def part(n):
        both.wait()  # nobody passes alone
        seen.add(threading.get_ident())

    whole = work.add(lambda: work.run(part, range(2)))
    work.add(lambda: time.sleep(0.05))  # the other thread comes when this is done
    with thread_pool(2) as pool:
        pool.submit(work.do)
        pool.submit(work.do)
        whole.result(timeout=300)
    assert len(seen) == 2


def test_what_a_task_raises_is_told_to_who_asks():
    work = SharedWork()

    def fails(n):
        if n == 3:
            raise ValueError("three")

    fine, bad = work.add(lambda: 1), work.add(lambda: work.run(fails, range(5)))
    work.do()
    assert fine.result() == 1
    with pytest.raises(ValueError, match="three"):
        bad.result()


def test_what_is_forgotten_is_not_done():
    done = []
    work = SharedWork()
    work.add(lambda: done.append(1))
    work.forget()
    work.do()
    assert done == []


def test_the_first_error_is_the_first_in_order():
    futures = [Future() for _ in range(3)]
    futures[0].set_result(None)
    futures[2].set_exception(KeyError("last"))
    futures[1].set_exception(ValueError("middle"))
    assert isinstance(first_error(futures), ValueError)
    assert first_error(futures[:1]) is None


def test_results_come_in_their_order_and_few_are_made_ahead():
    asked, done = [], []

    def arguments():
        for number in range(20):
            asked.append(number)
            yield number

    def work(number: int) -> int:
        time.sleep(0.01 if number % 3 == 0 else 0)
        done.append(number)
        return number * number

    with Ahead(work, arguments(), 3) as results:
        for number, result in results:
            assert result == number * number
            assert len(asked) <= number + 1 + 3
    assert sorted(done) == list(range(20))


def test_what_work_ahead_raises_is_raised_in_its_turn_and_the_rest_is_left():
    begun = []

    def work(number: int) -> int:
        begun.append(number)
        return 1 // (number - 4)

    def use() -> None:
        with Ahead(work, range(1000), 2) as results:
            for number, _ in results:
                assert number < 4

    with pytest.raises(ZeroDivisionError):
        use()
    assert len(begun) < 20
