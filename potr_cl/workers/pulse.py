"""Whether the processes of a cluster's workers still do anything: :class:`Pulse`.

A process that stands still keeps its connections, and Dask takes it for alive for minutes.
"""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dask.distributed import Client

#: Seconds without an answer after which a process counts as standing still: its event loop answers while it computes.
_STILL = 10.0


class Pulse:
    """Asks workers for a sign of life, by way of the scheduler.

    Args:
        client: of the cluster.
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
