"""How often Dask looks at its own processes: seldom, while they work for an encode. See :func:`look_seldom_for`.

A process of Dask looks at its event loop fifty times a second, at its memory and disks twice, and at what its threads
do a hundred times. That takes 4 to 5 % of a processor for scheduler, worker and its nanny, and dashboards alone
show it. What tells Dask who is alive, and the limits of memory, stay as they are.

Everything goes through Dask's plugins (https://distributed.dask.org/en/stable/plugins.html). A process that cannot be
reached, or does not know this package, goes on as before.
"""

from __future__ import annotations

import asyncio
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from distributed import Nanny, NannyPlugin, SchedulerPlugin, Worker, WorkerPlugin

if TYPE_CHECKING:
    from distributed import Client, Scheduler

#: Milliseconds between two looks. A loop that is looked at less often than every three seconds seems to hang.
_SELDOM = {"tick": 1000.0, "monitor": 5000.0, "profile": 2000.0}
_NAME = "potr_cl seldom looks"
#: Seconds to wait for the cluster: its scheduler waits for all of its processes, also for one that stands still.
_MOST = 60.0

#: Milliseconds of each server of this process as they were, while it looks seldom.
_before: weakref.WeakKeyDictionary[Any, dict[str, float]] = weakref.WeakKeyDictionary()


def look_seldom_for(client: Client) -> None:
    """Have the processes of a client's cluster look at themselves seldom, until the client leaves or is lost.

    Workers that come later do so too.
    """
    name = f"{_NAME} {client.id}"

    def register() -> None:
        with suppress(Exception):
            # The scheduler first: it sees to the end of all of them.
            client.register_plugin(_OfScheduler(client.id, name), name)
            client.register_plugin(_OfWorkers(), name)
            client.register_plugin(_OfNannies(), name)

    _wait_for(register)


def look_as_before_for(client: Client) -> None:
    """Undo :func:`look_seldom_for` for a client that stays; the scheduler waits until it leaves."""

    def unregister() -> None:
        for nanny in (False, True):
            with suppress(Exception):
                client.unregister_worker_plugin(f"{_NAME} {client.id}", nanny=nanny)

    if client.status == "running":
        _wait_for(unregister)


def _wait_for(work: Callable[[], None]) -> None:
    """Have something done, and wait for it, but not for ever; a process that ends does not wait for it either."""
    thread = threading.Thread(target=work, name=_NAME, daemon=True)
    thread.start()
    thread.join(_MOST)


def look_seldom(server: Any) -> None:
    """Have a server of Dask look at itself seldom; more than once does no harm."""
    before = _before.setdefault(server, {})
    for name, seldom in _SELDOM.items():
        look = server.periodic_callbacks.get(name)
        if look is not None and look.callback_time < seldom:
            before[name], look.callback_time = look.callback_time, seldom


def look_as_before(server: Any) -> None:
    """Undo :func:`look_seldom`."""
    for name, often in _before.pop(server, {}).items():
        server.periodic_callbacks[name].callback_time = often


class _OfWorkers(WorkerPlugin):  # type: ignore[misc]
    def setup(self, worker: Worker) -> None:
        look_seldom(worker)

    def teardown(self, worker: Worker) -> None:
        look_as_before(worker)


class _OfNannies(NannyPlugin):  # type: ignore[misc]
    def setup(self, nanny: Nanny) -> None:
        look_seldom(nanny)

    def teardown(self, nanny: Nanny) -> None:
        look_as_before(nanny)


class _OfScheduler(SchedulerPlugin):  # type: ignore[misc]
    """Ends with the client, and ends the others.

    Args:
        client: whose work it is.
        name: of all three plugins.
    """

    idempotent = True

    def __init__(self, client: str, name: str) -> None:
        self._client, self._name = client, name
        self._ending: asyncio.Task[None] | None = None

    async def start(self, scheduler: Scheduler) -> None:
        look_seldom(scheduler)

    def remove_client(self, scheduler: Scheduler, client: str) -> None:
        if client == self._client:
            self._ending = asyncio.ensure_future(self._end(scheduler))

    async def _end(self, scheduler: Scheduler) -> None:
        look_as_before(scheduler)
        with suppress(ValueError):
            scheduler.remove_plugin(self._name)
        # It logs with a traceback that a plugin has gone already, as after look_as_before_for.
        for plugins, leave in (
            (scheduler.worker_plugins, scheduler.unregister_worker_plugin),
            (scheduler.nanny_plugins, scheduler.unregister_nanny_plugin),
        ):
            if self._name in plugins:
                with suppress(Exception):
                    await leave(None, self._name)
