"""The workers of a Dask cluster: :class:`ClusterWorker` on the master's side, :class:`WorkerActor` on theirs."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotInTime
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from potr_cl.errors import DeviceError, PotrError, UsageError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, fitting_devices
from potr_cl.workers.client import first_line
from potr_cl.workers.pool import Held, Part, Shared, Worker, WorkerLost

if TYPE_CHECKING:
    from potr_cl.workers.cluster import ClusterPool

#: Seconds to wait for a worker to say which device it has.
_HELLO = 120.0


def host_of(address: str) -> str:
    return address.rsplit(":", 1)[0]


class ClusterWorker(Worker):
    """One of Dask's workers, with a actor for this pool.

    Args:
        place: its number among the workers of its computer.

    Attributes:
        device, digits: the name of its device and how it rounds, once it has been met.
    """

    device = digits = ""

    def __init__(self, pool: ClusterPool, name: str, place: int) -> None:
        self.name, self.host, self.place = name, host_of(name), place
        self._pool = pool
        self._known: list[tuple[int, Any]] = []  # what the actor has been sent
        self._next = 0
        self._sending = threading.Lock()
        options = {"actor": True, "workers": [name], "allow_other_workers": False, "pure": False}
        with _as_worker_lost(name):
            self._future = pool.client.submit(WorkerActor, place, **options)
        self._actor: Any = None

    def meet(self) -> None:
        """Wait until it says which device it has.

        Raises:
            UsageError: it cannot do the work.
            WorkerLost: it has gone.
        """
        try:
            self._actor = self._pool.wait_for(self._future, self.name, _HELLO)
            version, name, family, self.digits = self.ask("hello")
        except WorkerLost:
            # As those do that have no potr_cl.
            raise WorkerLost(
                f"worker {self.name} of the cluster has gone as it was asked for its device: see what it says itself, "
                "and install potr_cl there as it is here"
            ) from None
        except DeviceError as error:
            if "deserialization of the task graph" in str(error):  # which the scheduler does
                raise UsageError(
                    "the scheduler of the cluster does not know potr_cl: install it there as it is here"
                ) from None
            if not isinstance(error, WorkerFailed):
                raise UsageError(f"worker {self.name} of the cluster cannot do the work: {error}") from None
            raise UsageError(
                f"worker {self.name} of the cluster cannot do the work ({error.said}): install potr_cl there as it is "
                "here"
            ) from None
        _check(self.name, version, name, family, self._pool.first)
        # Hosts of two generations can call other processors by the same name.
        others = name == str(self._pool.first.info) and self.digits != self._pool.first.digits()
        self.device = f"{name} with other instructions" if others else name

    def ask(self, method: str, *args: Any) -> Any:
        """What a method of the actor returns."""
        with _as_worker_lost(self.name), self._pool.client.as_current():  # actors look for the client
            answer = getattr(self._actor, method)(*args)
        return self._pool.wait_for(answer, self.name)

    def make(self, kind: type[Part], memory: int | None, given: Sequence[Any]) -> Future[Held]:
        def made() -> Held:
            with self._sending:
                things = [
                    Shared(Known(self._sent(each.handle)), each.part) if isinstance(each, Shared) else each
                    for each in given
                ]
                self._next += 1
                number = self._next
                # Until it is made nothing else is sent, for which the actor would forget what this is made of.
                self.ask("make", number, kind, memory, things)
            return _HeldThere(self._pool, self, number)

        return self._pool.begin(made)

    def has(self, thing: Any) -> bool:
        """Whether the actor has been sent a thing, and keeps it."""
        return any(known is thing for _, known in self._known)

    def _sent(self, thing: Any) -> int:
        """The number by which the actor knows a thing, after sending it if need be."""
        number = next((number for number, known in self._known if known is thing), None)
        if number is None:
            self._next += 1
            number = self._next
            # Two: the uncompressed scene, and what is worked on now.
            kept = self._known[-1:]
            self.ask("keep", number, thing, [each for each, _ in kept])
            self._pool.traffic.add(sent=getattr(thing, "nbytes", 0), what=type(thing).__name__)
        else:
            kept = [each for each in self._known if each[1] is not thing]
        self._known = [*kept, (number, thing)]
        return number

    def leave(self) -> None:
        """Have Dask forget the actor, and with it all that it holds, as soon as it is idle."""
        with suppress(Exception):
            self._future.release()


class WorkerFailed(DeviceError):
    """Something else than this package failed on a worker."""

    def __init__(self, address: str, said: str) -> None:
        super().__init__(f"worker {address} failed ({said})")
        self.said = said


class _HeldThere(Held):
    """A part on one of Dask's workers."""

    def __init__(self, pool: ClusterPool, worker: ClusterWorker, number: int) -> None:
        self._pool, self._worker, self._number = pool, worker, number

    def begin(self, command: str, args: Sequence[Any]) -> Future[Any]:
        return self._pool.begin(lambda: self._worker.ask("run", self._number, command, tuple(args)))

    def abandon(self) -> None:
        # Without waiting: the worker may be gone, or stand still.
        with suppress(PotrError):
            self._pool.begin(lambda: self._worker.ask("drop", self._number))

    def close(self) -> None:
        # One that stands still, though Dask knows it, is not waited for ever: it forgets the part when it goes on.
        with suppress(PotrError, NotInTime):
            self._pool.begin(lambda: self._worker.ask("drop", self._number)).result(self._pool.patience)


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


@contextmanager
def _as_worker_lost(who: str) -> Iterator[None]:
    try:
        yield
    except PotrError:
        raise
    except Exception as error:
        raise WorkerLost(f"{who} does not answer ({first_line(error)})") from None


class WorkerActor:
    """Lives on a worker, and holds its parts and what they share.

    Args:
        place: the worker's number among those of its computer.
    """

    def __init__(self, place: int) -> None:
        self._place = place
        self._known: dict[int, Any] = {}
        self._parts: dict[int, Part] = {}

    def hello(self) -> tuple[str, str, str, str]:
        """The version here, the device, the family of its kernels, and its digits."""
        from potr_cl import __version__

        device = _device(self._place)
        return __version__, str(device.info), device.family, device.digits()

    def keep(self, number: int, thing: Any, others: Sequence[int]) -> None:
        """Keep a thing for parts, and of those that are known only the ones of these numbers."""
        self._known = {each: self._known[each] for each in others} | {number: thing}

    def make(self, number: int, kind: type[Part], memory: int | None, given: Sequence[Any]) -> None:
        """Make a part."""
        self._parts[number] = kind.made(_device(self._place), memory, given, lambda known: self._known[known.number])

    def run(self, number: int, command: str, args: Sequence[Any]) -> Any:
        """Give a part a command."""
        return self._parts[number].told(_device(self._place), command, args)

    def drop(self, number: int) -> None:
        """Give a part's memory back."""
        part = self._parts.pop(number, None)
        if part is not None:
            part.close()

    def __del__(self) -> None:
        # The master has left, perhaps without a word.
        for number in list(self.__dict__.get("_parts", ())):
            with suppress(Exception):
                self.drop(number)


@dataclass(frozen=True)
class Known:
    """Stands for something that the actor has been sent."""

    number: int


#: The devices that actors of this process have, by the actor's place.
opened: dict[int, Device] = {}


def _device(place: int) -> Device:
    """This worker's device: of the best ones, that of the worker's place among those of its computer."""
    if place not in opened:
        best, *others = fitting_devices()
        alike: list[DeviceInfo] = [best, *(info for info in others if _kind(info) == _kind(best))]
        opened[place] = Device(alike[place % len(alike)])
    return opened[place]


def _kind(info: DeviceInfo) -> tuple[str, str]:
    return info.kind, info.platform
