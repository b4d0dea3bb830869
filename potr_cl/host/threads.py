"""Threads that share a work: numpy leaves the interpreter free for others while it computes."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from itertools import islice
from typing import Any, Generic, TypeVar

S = TypeVar("S")
T = TypeVar("T")

#: Threads that work ahead, unless more are asked for.
_MOST_AHEAD = 4

#: What the names of threads begin with whose work nobody may be waiting for.
BACKGROUND = "potr_cl background"

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
    """Call a function in a thread of its own; what it returns or raises is the future's.

    The thread has this one's context: what bounds memory here, does there.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix=BACKGROUND)
    future = pool.submit(copy_context().run, work, *args)
    pool.shutdown(wait=False)
    return future


class Ahead(Generic[S, T]):
    """Results in their order, while threads are at work on the next ones; few are there at a time.

    A piece of work begins when the user has done with the result that lies as many before it as there are threads.

    ::

        with Ahead(work, arguments) as results:  # they have begun
            for argument, result in results:
                ...

    Args:
        work: called with each of the arguments.
        arguments: of which each is asked for only when its turn has come.
        threads: 0: one a processor, at most :data:`_MOST_AHEAD`.
    """

    def __init__(self, work: Callable[[S], T], arguments: Iterable[S], threads: int = 0) -> None:
        self._work, self._arguments = work, iter(arguments)
        self._threads = threads or min(os.cpu_count() or 1, _MOST_AHEAD)
        self._begun: deque[tuple[S, Future[T]]] = deque()

    def __enter__(self) -> Iterator[tuple[S, T]]:
        self._pool = ThreadPoolExecutor(self._threads)
        for _ in range(self._threads):
            self._begin()
        return self._results()

    def _begin(self) -> None:
        for argument in islice(self._arguments, 1):
            self._begun.append((argument, self._pool.submit(self._work, argument)))

    def _results(self) -> Iterator[tuple[S, T]]:
        while self._begun:
            argument, future = self._begun.popleft()
            yield argument, future.result()
            self._begin()

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)


class Spare(Generic[T]):
    """Memory that threads work in and leave for whoever comes next: what was written to before is there at once.

    Args:
        make: new memory, where none is left.
        most: so much of it is kept.
    """

    def __init__(self, make: Callable[[], T], most: float = math.inf) -> None:
        self._make, self._most = make, most
        self._free: list[T] = []

    @contextmanager
    def taken(self) -> Iterator[T]:
        """Some of it, for the block alone."""
        try:
            memory = self._free.pop()
        except IndexError:  # whatever other threads do meanwhile
            memory = self._make()
        try:
            yield memory
        finally:
            if len(self._free) < self._most:
                self._free.append(memory)

    def all(self) -> list[T]:
        """All that was made, while nobody is at work and none was too much."""
        return self._free
