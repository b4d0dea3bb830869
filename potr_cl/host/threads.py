"""Threads that share a work: numpy leaves the interpreter free for others while it computes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

T = TypeVar("T")

#: Calls a function with each of some arguments and gives the results in their order, as :func:`map` does. No call needs
#: another one's result.
Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


@contextmanager
def thread_pool(threads: int = 0) -> Iterator[ThreadPoolExecutor]:
    """Some threads, 0: one a processor."""
    pool = ThreadPoolExecutor(threads or os.cpu_count() or 1)
    try:
        yield pool
    finally:
        # After an error or Ctrl-C nothing that has not begun should begin.
        pool.shutdown(cancel_futures=True)


def in_background(work: Callable[..., T], *args: Any) -> Future[T]:
    """Call a function in a thread of its own; what it returns or raises is the future's."""
    pool = ThreadPoolExecutor(1)
    future = pool.submit(work, *args)
    pool.shutdown(wait=False)
    return future
