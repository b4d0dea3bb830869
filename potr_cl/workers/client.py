"""A client of a Dask cluster (:func:`client_of`), and whether its workers still do anything (:class:`Pulse`)."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from potr_cl.errors import UsageError
from potr_cl.host.libraries import install_command

if TYPE_CHECKING:
    from dask.distributed import Client

#: Seconds to wait for a scheduler.
_CONNECT = 5.0


def client_of(cluster: str | Client) -> tuple[Client, bool]:
    """A client, and whether it was made here: then it goes to the workers itself, and not by way of the scheduler.

    Args:
        cluster: the scheduler's address, or a client.

    Raises:
        UsageError: Dask is not installed, it is neither, or no scheduler answers there.
    """
    try:
        from dask.distributed import Client
    except ImportError:
        raise UsageError(f"a cluster needs Dask: {install_command('cluster')}") from None
    if isinstance(cluster, Client):
        return cluster, False
    if not isinstance(cluster, str):
        raise UsageError(
            f"a cluster is the address of a Dask scheduler, or a dask.distributed.Client, not {type(cluster).__name__}"
        )
    if not cluster.strip():
        raise UsageError("--cluster is empty: give the address of a Dask scheduler, such as tcp://10.0.0.1:8786")
    # What it has to say is said here, in one line. Some of its modules' loggers have levels of their own.
    for name in ["distributed", *(name for name in logging.root.manager.loggerDict if name.startswith("distributed."))]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return Client(cluster, timeout=_CONNECT, set_as_default=False, direct_to_workers=True), True
    except Exception as error:
        # Of another program's answer it takes the first bytes for a size.
        said = "something else does" if isinstance(error, MemoryError) else first_line(error)
        raise UsageError(
            f"no Dask scheduler answers at '{cluster}' ({said}): give its address, such as tcp://10.0.0.1:8786"
        ) from None


def first_line(error: BaseException) -> str:
    """What an error says, in one line that is not long."""
    said = str(error).strip().partition("\n")[0][:200]
    return said or type(error).__name__


#: Seconds without an answer after which a process counts as standing still: its event loop answers while it computes.
_STILL = 10.0


class Pulse:
    """Asks workers for a sign of life, by way of the scheduler.

    A process that stands still keeps its connections, and Dask takes it for alive for minutes.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        #: Since when those have been asked that have not answered, and when they were asked last.
        self._asked: dict[str, tuple[float, float]] = {}
        self._lock = threading.Lock()

    def is_still(self, address: str) -> bool:
        """Whether a worker has not answered for long. To be asked every few seconds: each time begins to ask it."""
        now = time.monotonic()
        with self._lock:
            since, last = self._asked.get(address, (now, now))
            if last + _STILL < now:  # nobody has waited for it meanwhile: an answer that was lost then says nothing
                since = now
            self._asked[address] = since, now
        if since + _STILL < now:
            return True
        with suppress(RuntimeError):  # the client is closed
            asking = asyncio.run_coroutine_threadsafe(self._ask(address), self._client.loop.asyncio_loop)
            asking.add_done_callback(lambda _: self._note(address, asking))
        return False

    async def _ask(self, address: str) -> Any:
        asking = self._client.scheduler.broadcast(msg={"op": "identity"}, workers=[address])
        return await asyncio.wait_for(asking, 2 * _STILL)

    def _note(self, address: str, asking: Future[Any]) -> None:
        with self._lock:
            if not asking.cancelled() and asking.exception() is None:
                self._asked.pop(address, None)
