"""A Dask cluster: :class:`ClusterPool`. Every worker of it is a worker here, with a device of its own.

Dask brings the network, placing things on workers, and who is alive. A worker's parts, and what they share, live in an
actor there (:mod:`potr_cl.workers.actor`). Dask's own way to share things (``scatter``) keeps only one copy of
them in the long run, and that goes with its worker. The master only adds up what the workers find.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from potr_cl.errors import DeviceError, PotrError, UsageError
from potr_cl.opencl.device import Device
from potr_cl.workers.actor import ClusterWorker, WorkerFailed, host_of
from potr_cl.workers.client import Pulse, client_of, first_line
from potr_cl.workers.host import DeviceThread
from potr_cl.workers.pool import Pool, Traffic, Worker, WorkerLost, tell_of_kinds

if TYPE_CHECKING:
    from dask.distributed import Client

#: Seconds to wait for the first worker to come.
_COME = 60.0
#: Seconds between two looks at whether a worker that has not answered yet is alive, and at whether to go on waiting.
_ALIVE, _POLL = 3.0, 0.1
#: The second of them grows by this factor from look to look, up to so much: each look wakes the client's event loop.
_POLL_GROWS, _MOST_POLL = 1.5, 1.0
#: Seconds between two looks at whether workers have come.
_NEW = 2.0
#: Seconds in which the handle of a part arrives once it is made.
_FETCH = 30.0
#: Seconds in which the scheduler says who is alive, and how often it is asked before it counts as gone: it answers at
#: once, unless it stands still, or the client is closed meanwhile; but this process may have stood still itself.
_WHO, _ASKED = 6.0, 2
#: Threads that wait for workers.
_MOST_WAITING = 256

_log = logging.getLogger("potr_cl")


class ClusterPool(Pool):
    """The workers of a Dask cluster. Those that come later do views from the next work on.

    Args:
        cluster: the scheduler's address, or a client of it, which stays the caller's.
        first: the master's device.

    Raises:
        UsageError: Dask is not installed, no scheduler answers there, no worker comes, or one cannot do the work.
    """

    def __init__(self, cluster: str | Client, first: Device, patience: float = 60.0) -> None:
        self.first, self.traffic, self.patience = first, Traffic(), patience
        self._closing = threading.Event()
        self._waiting = ThreadPoolExecutor(_MOST_WAITING, thread_name_prefix="potr_cl cluster")
        self._workers: list[ClusterWorker] = []
        self._here: DeviceThread | None = None
        self._is_gone = False  # the scheduler
        self._refused: set[str] = set()
        self._meeting = threading.Lock()
        self._owned = ExitStack()
        self.client, is_own = client_of(cluster)
        self._pulse = Pulse(self.client)
        if is_own:
            self._owned.callback(self._leave_cluster)
        try:
            self._meet_first()
            threading.Thread(target=self._meet_others, name="potr_cl newcomers", daemon=True).start()
        except BaseException:
            self.close()
            raise

    def workers(self) -> list[Worker]:
        try:
            alive = self._alive()
        except WorkerLost as error:
            return [self._goes_on_here(str(error))]
        left: list[Worker] = [worker for worker in self._workers if worker.name in alive and not worker.lost]
        if not left:
            return [self._goes_on_here("no worker of the cluster answers any more")]
        return left

    def _goes_on_here(self, why: str) -> Worker:
        """The master's own device, where there is no cluster any more: results do not depend on who computes them."""
        with self._meeting:
            if self._here is None:
                _log.warning("%s: continuing on %s of this computer alone; Ctrl-C to stop", why, self.first.info)
                self._here = DeviceThread(self.first, 0)
            return self._here

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(worker.name for worker in [*self._workers, *([] if self._here is None else [self._here])])

    def has(self, thing: Any) -> bool:
        return all(worker.has(thing) for worker in self._workers if not worker.lost)

    def close(self) -> None:
        with self._meeting:
            self._closing.set()
        self._waiting.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.leave()
        if self._here is not None:
            self._here.close()
        self._owned.close()

    def _leave_cluster(self) -> None:
        with suppress(Exception):
            self.client.close(timeout=2)

    # ------------------------------------------------------------------------------------------------ for the workers

    def _alive(self) -> set[str]:
        """Addresses of the workers that the scheduler knows.

        Raises:
            WorkerLost: it is gone. Once there have been workers, the user has been told then, and they have been left.
        """
        for _ in range(_ASKED):
            # With the connection Dask gives up all that it has on workers, also if it can be made again.
            if self.client.status == "running" and not self._is_gone:
                with suppress(Exception):
                    return set(self.client.sync(self.client.scheduler.ncores, callback_timeout=_WHO))
        why = "the cluster's scheduler does not answer any more"
        if not self._workers:
            raise WorkerLost(why)
        # Workers may answer for a while, and then no more.
        self._is_gone = True
        for worker in self._workers:
            worker.lost = worker.told = True
        if not self._closing.is_set():
            self._goes_on_here(why)
        raise WorkerLost(why)

    def wait_for(self, answer: Any, address: str, most: float = math.inf) -> Any:
        """What a worker answers.

        Args:
            most: seconds to wait.

        Raises:
            WorkerLost: it is gone. Whatever the worker raises.
        """
        began = looked = time.monotonic()
        poll = _POLL
        while not self._answered(answer, poll):
            poll = min(_POLL_GROWS * poll, _MOST_POLL)
            if time.monotonic() - began > most:
                raise WorkerLost(f"{address} does not answer")
            if self._closing.is_set():
                raise WorkerLost(f"{address} is not waited for any more")
            if self._is_gone or self.client.status != "running" or time.monotonic() - looked > _ALIVE:
                looked = time.monotonic()
                if address not in self._alive():
                    raise WorkerLost(f"{address} is gone")
                if self._pulse.is_still(address):
                    for worker in self._workers:
                        worker.lost |= worker.name == address
                    raise WorkerLost("it does not answer")
        try:
            return answer.result(timeout=_FETCH)
        except PotrError:
            raise
        except MemoryError:
            raise DeviceError(f"worker {address} ran out of memory") from None
        except Exception as error:
            if self._closing.is_set() or address not in self._alive() or _is_of_transport(error):
                raise WorkerLost(f"{address} is gone ({first_line(error)})") from None
            raise WorkerFailed(address, first_line(error)) from error

    def _answered(self, answer: Any, seconds: float) -> bool:
        """Whether an answer is there, after waiting a little for it."""
        if answer.done():
            return True
        with suppress(Exception):  # whatever it is, it will be raised again
            if hasattr(answer, "add_done_callback"):
                # What is on its way already must not be cut short.
                done = threading.Event()
                answer.add_done_callback(lambda _: done.set())
                done.wait(seconds)
            else:
                answer.result(timeout=seconds)
        return bool(answer.done())

    def begin(self, work: Callable[[], Any]) -> Future[Any]:
        """Have something waited for in a thread."""
        try:
            return self._waiting.submit(work)
        except RuntimeError:  # closed
            raise WorkerLost("the cluster has been left") from None

    def _meet_first(self) -> None:
        """Have each worker that is there say which device it takes.

        Raises:
            UsageError: no worker comes, one cannot do the work, or all of them go.
        """
        addresses = self._alive()
        if not addresses:
            _log.warning("the cluster has no worker yet: waiting %.0f seconds for one", _COME)
            end = time.monotonic() + _COME
            while not addresses and time.monotonic() < end:
                time.sleep(_POLL)
                addresses = self._alive()
        if not addresses:
            raise UsageError("the cluster has no worker: start some with `dask worker ADDRESS`, one for each device")
        workers = self._invited(addresses)
        gone: list[WorkerLost] = []
        for worker in list(workers):
            try:
                worker.meet()
            except WorkerLost as error:
                workers.remove(worker)
                self._refused.add(worker.name)
                gone.append(error)
        if not workers:
            raise UsageError(f"{gone[0]}, and no other worker is there")
        here = self.first.digits()
        self._digits = here if any(worker.digits == here for worker in workers) else workers[0].digits
        for lost in gone:
            _log.warning("%s; ignoring this worker", lost)
        self._take_in([worker for worker in workers if self._rounds_as_others(worker)])

    def _rounds_as_others(self, worker: ClusterWorker) -> bool:
        """Whether a worker that has been met computes to the same digits; if not it is left, and the user told."""
        if worker.digits == self._digits:
            return True
        self._refused.add(worker.name)
        worker.leave()
        _log.warning(
            "worker %s (%s) rounds differently from the others, so that the file would depend on which views it gets; "
            "ignoring it. To choose, start workers on one kind of device (POTR_CL_DEVICE in their environment) and "
            "hosts of one generation",
            worker.name, worker.device,
        )  # fmt: skip
        return False

    def _meet_others(self) -> None:
        """Meet those that come, until the cluster is left or its scheduler is gone."""
        # One that dies as it is asked would be started again and again by Dask.
        lost: set[str] = set()
        while not self._closing.wait(_NEW):
            if self._is_gone:
                return
            with suppress(WorkerLost):
                come = self._alive() - {worker.name for worker in self._workers} - self._refused
                for worker in self._invited({address for address in come if host_of(address) not in lost}):
                    try:
                        worker.meet()
                    except (UsageError, WorkerLost) as error:
                        self._refused.add(worker.name)
                        if isinstance(error, WorkerLost):
                            lost.add(worker.host)
                        worker.leave()
                        if not self._closing.is_set():
                            _log.warning("%s; ignoring this worker", error)
                        continue
                    if self._rounds_as_others(worker):
                        _log.warning("worker %s joined; it gets views from the next stage on", worker.name)
                        self._take_in([worker])

    def _invited(self, addresses: set[str]) -> list[ClusterWorker]:
        """Workers that have begun to say which device they take: those of one computer take its devices in turn."""
        alive, invited = self._alive(), list[ClusterWorker]()
        for address in sorted(addresses):
            there = [
                each for each in [*self._workers, *invited] if each.host == host_of(address) and each.name in alive
            ]
            place = min(set(range(len(there) + 1)) - {each.place for each in there})
            invited.append(ClusterWorker(self, address, place))
        return invited

    def _take_in(self, workers: Sequence[ClusterWorker]) -> None:
        with self._meeting:
            self._workers = [*self._workers, *workers]
            if self._closing.is_set():
                for worker in workers:
                    worker.leave()
                return
        if any(worker.device != str(self.first.info) for worker in workers):
            tell_of_kinds(str(self.first.info), (worker.device for worker in self._workers))


def _is_of_transport(error: Exception) -> bool:
    return isinstance(error, (OSError, EOFError)) or "lost" in str(error).lower() or "cancel" in repr(error).lower()
