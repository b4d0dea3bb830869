"""Signs of life of a cluster's workers."""

from __future__ import annotations

import asyncio
import threading
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from potr_cl.workers import client as clients
from potr_cl.workers.client import Pulse


@pytest.fixture
def loop():
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield loop
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


@pytest.fixture
def clock(monkeypatch):
    """Tells when it is; in seconds after which nobody has answered for too long."""
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(clients, "time", SimpleNamespace(monotonic=lambda: clock.now * clients._STILL))
    return clock


def watching(loop, lost):
    """The signs of life of a worker whose first answers are lost, and how often it has been asked."""
    asked = []

    async def broadcast(msg: Any, workers: list[str]) -> dict[str, Any]:
        asked.append(workers)
        if len(asked) <= lost:
            raise OSError("lost")
        return {workers[0]: {}}

    client = SimpleNamespace(loop=SimpleNamespace(asyncio_loop=loop), scheduler=SimpleNamespace(broadcast=broadcast))
    return Pulse(cast(Any, client)), asked


def test_an_answer_that_was_lost_long_ago_says_nothing(loop, clock):
    watch, asked = watching(loop, lost=1)
    assert not watch.is_still("a")
    clock.now += 1.7  # its work has ended meanwhile; another begins
    assert not watch.is_still("a")
    clock.now += 0.7
    assert not watch.is_still("a")
    until = time.monotonic() + 300
    while len(asked) < 2:
        assert time.monotonic() < until
        time.sleep(0.01)


def test_who_never_answers_stands_still(loop, clock):
    watch, _ = watching(loop, lost=1000)
    found = []
    for _ in range(4):
        found.append(watch.is_still("a"))
        clock.now += 0.4
    assert found == [False, False, False, True]
