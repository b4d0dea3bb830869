"""Threads that share a work: numpy leaves the interpreter free for others while it computes."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
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
    """Call a function in a thread of its own; what it returns or raises is the future's."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=BACKGROUND)
    future = pool.submit(work, *args)
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


class SharedWork:
    """Tasks that some threads take one by one, each the next that nobody has taken.

    A task may share out parts of its own work (:meth:`run`): these come before all other tasks, and the thread that
    shares them out does what nobody else takes, so that it never waits for a thread to be free.
    """

    def __init__(self) -> None:
        self._tasks: deque[_Task] = deque()

    def add(self, work: Callable[[], Any]) -> Future[Any]:
        """A task behind all others; what it returns or raises is the future's."""
        self._tasks.append(task := _Task(work))
        return task.future

    def do(self) -> None:
        """A thread's share: tasks until none are left that nobody has taken. What they raise is in their futures."""
        while True:
            try:
                task = self._tasks.popleft()
            except IndexError:
                return
            task.do()

    def run(self, work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Call a function with each item, with the help of threads that do their share meanwhile (:data:`Run`).

        Raises:
            What one of the calls raises; others may not have been made then.
        """
        tasks = [_Task(partial(work, item)) for item in items]
        self._tasks.extendleft(reversed(tasks))
        for task in tasks:
            task.do()
        return [task.future.result() for task in tasks]

    def forget(self) -> None:
        """Leave what nobody has taken undone."""
        self._tasks.clear()


class _Task:
    """Something to be done once, by whoever comes first."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work = work
        self._mine = deque((True,))  # what is popped is nobody else's
        self.future: Future[Any] = Future()

    def do(self) -> None:
        try:
            self._mine.pop()
        except IndexError:
            return
        try:
            self.future.set_result(self._work())
        except Exception as error:  # the one who asks for the result is told
            self.future.set_exception(error)
        except BaseException as error:  # Ctrl-C
            self.future.set_exception(error)
            raise


def first_error(futures: Iterable[Future[Any]]) -> BaseException | None:
    """Wait until all is done, or until something raised: what the first in their order has raised, or None."""
    futures = list(futures)
    done, _ = wait(futures, return_when=FIRST_EXCEPTION)
    errors = (future.exception() for future in futures if future in done)
    return next((error for error in errors if error is not None), None)
