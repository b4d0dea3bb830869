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


def test_an_answer_that_was_lost_long_ago_says_nothing(loop, monkeypatch):
    monkeypatch.setattr(clients, "_STILL", 0.3)
    asked = []

    async def broadcast(msg: Any, workers: list[str]) -> dict[str, Any]:
        asked.append(workers)
        if len(asked) == 1:
            raise OSError("lost")
        return {workers[0]: {}}

    client = SimpleNamespace(loop=SimpleNamespace(asyncio_loop=loop), scheduler=SimpleNamespace(broadcast=broadcast))
    watch = Pulse(cast(Any, client))
    assert not watch.is_still("a")
    time.sleep(0.5)  # its work has ended meanwhile; another begins
    assert not watch.is_still("a")
    time.sleep(0.2)
    assert not watch.is_still("a")
    assert len(asked) >= 2


def test_who_never_answers_stands_still(loop, monkeypatch):
    monkeypatch.setattr(clients, "_STILL", 0.3)

    async def broadcast(msg: Any, workers: list[str]) -> dict[str, Any]:
        raise OSError("no answer")

    client = SimpleNamespace(loop=SimpleNamespace(asyncio_loop=loop), scheduler=SimpleNamespace(broadcast=broadcast))
    watch = Pulse(cast(Any, client))
    until = time.monotonic() + 60
    while not watch.is_still("a"):
        assert time.monotonic() < until
        time.sleep(0.1)
