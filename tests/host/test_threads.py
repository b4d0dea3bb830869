"""Threads that share a work."""

from __future__ import annotations

import time

import pytest

from potr_cl.host.threads import Ahead, Spare


def test_memory_is_left_for_the_next_and_little_is_kept():
    made = []
    spare = Spare(lambda: made.append(len(made)) or made[-1], most=2)
    with spare.taken() as first, spare.taken() as second, spare.taken() as third:
        assert {first, second, third} == {0, 1, 2}
    assert len(spare.all()) == 2
    with pytest.raises(ValueError, match="here"), spare.taken():
        raise ValueError("here")
    with spare.taken():
        pass
    assert len(made) == 3


def test_results_come_in_their_order_and_few_are_made_ahead():
    asked, done = [], []

    def arguments():
        for number in range(20):
            asked.append(number)
            yield number

    def work(number):
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

    def work(number):
        begun.append(number)
        return 1 // (number - 4)

    def use():
        with Ahead(work, range(1000), 2) as results:
            for number, _ in results:
                assert number < 4

    with pytest.raises(ZeroDivisionError):
        use()
    assert len(begun) < 20
