"""A Dask cluster: :class:`ClusterPool`. Every worker of it is a worker here, with a device of its own.

Dask brings scheduling, the network, and who is alive. A part lives in an actor (:class:`_Seat`) on one worker; what is
shared is scattered to all workers once. The master only adds up what they find.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from potr_cl.errors import DeviceError, PotrError, UsageError
from potr_cl.host.installation import install_command
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, fitting_devices
from potr_cl.workers.pool import Held, Part, Pool, Shared, Traffic, Worker, WorkerLost

if TYPE_CHECKING:
    from dask.distributed import Client

#: Seconds to wait for a scheduler, and for a worker to say which device it has.
_CONNECT, _HELLO = 10.0, 120.0
#: Seconds between two looks at whether a worker that has not answered yet is alive, and at whether to go on waiting.
_ALIVE, _POLL = 3.0, 0.1
#: Seconds in which the handle of a part arrives once it is made.
_FETCH = 30.0
#: Seconds to wait for a worker to give a part's memory back.
_CLOSE = 60.0


class ClusterPool(Pool):
    """The workers of a Dask cluster.

    Args:
        cluster: the scheduler's address, or a client of it, which stays the caller's.
        first: the master's device.
        patience: see :class:`potr_cl.workers.pool.Pool`.

    Raises:
        UsageError: Dask is not installed, no scheduler answers there, or it has no worker that can do the work.
    """

    takes_part = False
    sparse = True

    def __init__(self, cluster: str | Client, first: Device, patience: float = 60.0) -> None:
        self.first, self.traffic, self.patience = first, Traffic(), patience
        self._closing = threading.Event()
        self.client, self._is_own = _client_of(cluster)
        self._scattered: list[tuple[Any, Any]] = []
        self._waiting = ThreadPoolExecutor(256, thread_name_prefix="potr_cl cluster")
        try:
            self._workers = self._met()
        except BaseException:
            self.close()
            raise

    def workers(self) -> list[Worker]:
        alive = self._alive()
        left: list[Worker] = [worker for worker in self._workers if worker.name in alive]
        if not left:
            raise WorkerLost("all workers of the cluster are gone: start some, and encode again")
        return left

    @contextmanager
    def shared(self, thing: Any) -> Iterator[Shared]:
        """Scattered to all workers; what is shared again later is still there."""
        future = next((future for known, future in self._scattered if known is thing), None)
        if future is None:
            with _lost_as_worker_lost("the cluster"):
                future = self.client.scatter(thing, broadcast=True, hash=False)
            self.traffic.sent += getattr(thing, "nbytes", 0) * len(self._workers)
        # Two scenes: the uncompressed one, and what is worked on now.
        others = [each for each in self._scattered if each[0] is not thing]
        self._scattered = [*others[-1:], (thing, future)]
        yield Shared(future)

    def close(self) -> None:
        self._closing.set()
        self._scattered.clear()
        self._waiting.shutdown(wait=False, cancel_futures=True)
        if self._is_own:
            with suppress(Exception):
                self.client.close(timeout=2)

    # ------------------------------------------------------------------------------------------------ for the workers

    def _alive(self) -> set[str]:
        """Addresses of the workers that the scheduler knows."""
        with _lost_as_worker_lost("the scheduler"):
            return set(self.client.nthreads())

    def wait_for(self, answer: Any, address: str) -> Any:
        """What a worker answers.

        Raises:
            WorkerLost: it is gone. Whatever the worker raises.
        """
        looked = time.monotonic()
        while not self._answered(answer):
            if self._closing.is_set():
                raise WorkerLost(f"{address} is not waited for any more")
            if time.monotonic() - looked > _ALIVE:
                looked = time.monotonic()
                if address not in self._alive():
                    raise WorkerLost(f"{address} is gone")
        try:
            return answer.result(timeout=_FETCH)
        except PotrError:
            raise
        except MemoryError:
            raise DeviceError(f"worker {address} ran out of memory") from None
        except Exception as error:
            if self._closing.is_set() or address not in self._alive() or _is_of_transport(error):
                raise WorkerLost(f"{address} is gone ({_first_line(error)})") from None
            raise DeviceError(f"worker {address} failed ({_first_line(error)})") from error

    def _answered(self, answer: Any) -> bool:
        """Whether an answer is there, after waiting a little for it."""
        if answer.done():
            return True
        with suppress(Exception):  # whatever it is, it will be raised again
            if hasattr(answer, "add_done_callback"):
                # What is on its way already must not be cut short.
                done = threading.Event()
                answer.add_done_callback(lambda _: done.set())
                done.wait(_POLL)
            else:
                answer.result(timeout=_POLL)
        return bool(answer.done())

    def begin(self, work: Callable[[], Any]) -> Future[Any]:
        """Have something waited for in a thread."""
        try:
            return self._waiting.submit(work)
        except RuntimeError:  # closed
            raise WorkerLost("the cluster has been left") from None

    def _met(self) -> list[_ClusterWorker]:
        """All workers, each of which has said which device it takes."""
        addresses = sorted(self._alive())
        if not addresses:
            raise UsageError("the cluster has no worker: start some with `dask worker ADDRESS`, one for each device")
        # Several workers of one computer take its devices in turn.
        hosts = [address.rsplit(":", 1)[0] for address in addresses]
        places = [hosts[:number].count(host) for number, host in enumerate(hosts)]
        asked = [
            self.client.submit(_hello, place, workers=[address], allow_other_workers=False, pure=False)
            for address, place in zip(addresses, places, strict=True)
        ]
        workers = []
        for address, place, answer in zip(addresses, places, asked, strict=True):
            try:
                version, name, family = answer.result(timeout=_HELLO)
            except PotrError as error:
                raise UsageError(f"worker {address} of the cluster: {error}") from None
            except Exception as error:
                raise UsageError(
                    f"worker {address} of the cluster cannot do the work ({_first_line(error)}): install potr_cl there "
                    "as it is here"
                ) from None
            _check(address, version, name, family, self.first)
            workers.append(_ClusterWorker(self, address, place))
        return workers


class _ClusterWorker(Worker):
    """One of Dask's workers."""

    def __init__(self, pool: ClusterPool, address: str, place: int) -> None:
        self.name = address
        self._pool, self._place = pool, place

    def make(self, kind: type[Part], memory: int | None, given: Sequence[Any]) -> Future[Held]:
        # Dask hands an actor what was scattered when it makes it, so these come first.
        shared = [each.handle for each in given if isinstance(each, Shared)]
        rest = [_Place() if isinstance(each, Shared) else each for each in given]

        def made() -> Held:
            with _lost_as_worker_lost(self.name):
                seat = self._pool.client.submit(
                    _Seat, *shared, actor=True, workers=[self.name], allow_other_workers=False, pure=False
                )
            held = _HeldThere(self._pool, self.name, seat, self._pool.wait_for(seat, self.name))
            held.wait("make", self._place, kind, memory, rest)
            return held

        return self._pool.begin(made)


class _HeldThere(Held):
    """A part on one of Dask's workers."""

    def __init__(self, pool: ClusterPool, address: str, future: Any, seat: Any) -> None:
        self._pool, self._address, self._future, self._seat = pool, address, future, seat

    def wait(self, method: str, *args: Any) -> Any:
        """What a method of the seat returns."""
        try:
            with self._pool.client.as_current():  # actors look for it
                answer = getattr(self._seat, method)(*args)
        except Exception as error:
            raise WorkerLost(f"{self._address} is gone ({_first_line(error)})") from None
        return self._pool.wait_for(answer, self._address)

    def begin(self, command: str, args: Sequence[Any]) -> Future[Any]:
        return self._pool.begin(lambda: self.wait("run", command, tuple(args)))

    def close(self) -> None:
        with suppress(Exception):
            if not self._pool._closing.is_set():
                with self._pool.client.as_current():
                    self._seat.close().result(timeout=_CLOSE)
        with suppress(Exception):
            self._future.release()  # the worker then forgets the seat, as soon as it is idle


class _Place:
    """Stands for a shared thing among what a part is made with."""


class _Seat:
    """Lives on a worker and holds a part.

    Args:
        shared: things that were scattered, for the part.
    """

    def __init__(self, *shared: Any) -> None:
        self._shared = shared
        self._part: Part | None = None

    def make(self, place: int, kind: type[Part], memory: int | None, given: Sequence[Any]) -> None:
        """Make the part."""
        shared = iter(self._shared)
        things = [next(shared) if isinstance(each, _Place) else each for each in given]
        self._device = _device(place)
        # A failure may leave buffers behind that nobody owns any more.
        with self._device.all_or_nothing(), self._device.errors("failed while encoding"):
            self._part = kind(self._device, memory, *things)
        self._shared = ()

    def run(self, command: str, args: Sequence[Any]) -> Any:
        """Give the part a command."""
        with self._device.errors("failed while encoding"):
            return getattr(self._part, command)(*args)

    def close(self) -> None:
        """Give the part's memory back."""
        part, self._part = self._part, None
        if part is not None:
            part.close()

    def __del__(self) -> None:
        # The master has gone without a word, or does not wait.
        with suppress(Exception):
            self.close()


_opened: dict[int, Device] = {}


def _device(place: int) -> Device:
    """This worker's device: of the best ones, that of the worker's place among those of its computer."""
    if place not in _opened:
        best, *others = fitting_devices()
        alike: list[DeviceInfo] = [best, *(info for info in others if _kind(info) == _kind(best))]
        _opened[place] = Device(alike[place % len(alike)])
    return _opened[place]


def _kind(info: DeviceInfo) -> tuple[str, str]:
    return info.kind, info.platform


def _hello(place: int) -> tuple[str, str, str]:
    """On a worker: which version it has, and which device and kernels it takes."""
    from potr_cl import __version__

    device = _device(place)
    return __version__, str(device.info), device.family


def _check(address: str, version: str, name: str, family: str, first: Device) -> None:
    from potr_cl import __version__

    if version != __version__:
        raise UsageError(
            f"worker {address} of the cluster has potr_cl {version}, this computer {__version__}: install the same"
        )
    if family != first.family:
        raise UsageError(
            f"worker {address} of the cluster computes on {name}, this computer on {first.info}, which round "
            "differently: choose a device of the same kind with --device"
        )


def _client_of(cluster: str | Client) -> tuple[Client, bool]:
    """A client, and whether it was made here."""
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
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what it has to say is said here, in one line
    try:
        return Client(cluster, timeout=_CONNECT, set_as_default=False, direct_to_workers=True), True
    except Exception as error:
        raise UsageError(
            f"no Dask scheduler answers at '{cluster}' ({_first_line(error)}): give its address, such as "
            "tcp://10.0.0.1:8786"
        ) from None


def _is_of_transport(error: Exception) -> bool:
    return isinstance(error, (OSError, EOFError)) or "lost" in str(error).lower() or "cancel" in repr(error).lower()


@contextmanager
def _lost_as_worker_lost(who: str) -> Iterator[None]:
    try:
        yield
    except PotrError:
        raise
    except Exception as error:
        raise WorkerLost(f"{who} does not answer ({_first_line(error)})") from None


def _first_line(error: BaseException) -> str:
    said = str(error).strip().partition("\n")[0][:200]
    return said or type(error).__name__
