"""Who was lost as it was met is asked again, ever later."""

from __future__ import annotations

from itertools import pairwise

from potr_cl.workers.pauses import Pauses


def asked_at(pauses, host, seconds, look, works_at=None):
    """When somebody is asked who is looked at all the time."""
    found, now = [], 0.0
    while now < seconds:
        if pauses.may_ask(host, now):
            found.append(now)
            if now == works_at:
                pauses.note_met(host)
            else:
                pauses.note_lost(host, now)
        now += look
    return found


def test_each_pause_is_twice_as_long():
    assert asked_at(Pauses(2.0), "a", 100, 2.0) == [0, 2, 6, 14, 30, 62]


def test_pauses_are_a_minute_at_most():
    asked = asked_at(Pauses(2.0), "a", 3_600, 2.0)
    assert [after - before for before, after in pairwise(asked)][-10:] == [60] * 10


def test_computers_do_not_wait_for_each_other():
    pauses = Pauses(2.0)
    assert pauses.note_lost("a", 0.0)
    assert not pauses.note_lost("a", 2.0)
    assert not pauses.may_ask("a", 5.0)
    assert pauses.may_ask("b", 5.0)


def test_one_that_is_met_ends_the_pauses():
    assert asked_at(Pauses(2.0), "a", 40, 2.0, works_at=14.0) == [0, 2, 6, 14, 16, 18, 22, 30]
