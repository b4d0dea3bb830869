"""A pool of workers, each with a device of its own: :class:`Pool`. What they compute is in :mod:`.parts`.

Whoever asks a pool for work (the *master*) has a device too, the pool's ``first``. Where workers are threads of its
process, as with several devices of one computer, it does a share of the work; with a cluster it only adds up what they
find.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner

if TYPE_CHECKING:
    from typing_extensions import Self


_FAILED = "failed while encoding"


class WorkerLost(DeviceError):
    """A worker does not answer any more; others can do its work."""


def tell_of_kinds(first: str, others: Iterable[str]) -> None:
    """Say that the file can depend on who computes what, if there are devices of several kinds.

    Args:
        first: the master's device; others: those of workers.
    """
    kinds = sorted({first, *others})
    if len(kinds) > 1:
        logging.getLogger("potr_cl").warning(
            "there are devices of several kinds (%s), which round differently: the file can depend on who gets which "
            "views",
            ", ".join(kinds),
        )


class Part(Owner, ABC):
    """A part of a work, on one worker: its methods are the commands that the master gives.

    It is made on its worker as ``kind(device, memory, *given)``, where memory is the number of bytes of the device's
    memory that may be filled with views, or None. The same commands in the same order give the same results on any
    worker, so that a part can be made again elsewhere.
    """

    @abstractmethod
    def __init__(self, device: Device, memory: int | None, *given: Any) -> None: ...

    @classmethod
    def made(
        cls, device: Device, memory: int | None, given: Sequence[Any], known: Callable[[Any], Any] = lambda thing: thing
    ) -> Self:
        """A part on this device, of what was given; ``known`` finds what was shared by its handle."""
        # A failure may leave buffers behind that nobody owns any more.
        with device.all_or_nothing(), device.errors(_FAILED):
            return cls(
                device, memory, *(each.of(known(each.handle)) if isinstance(each, Shared) else each for each in given)
            )

    def told(self, device: Device, command: str, args: Sequence[Any]) -> Any:
        """What a command returns, on the device that the part is on."""
        with device.errors(_FAILED):
            return getattr(self, command)(*args)


class Held(ABC):
    """A part that a worker holds."""

    @abstractmethod
    def begin(self, command: str, args: Sequence[Any]) -> Future[Any]:
        """Have the part's method of this name called; what it returns or raises is the future's.

        Commands of one part run one after the other. A worker that is gone raises :class:`WorkerLost`.
        """

    @abstractmethod
    def close(self) -> None:
        """Have the worker forget the part; a worker that is gone is none to wait for."""

    def abandon(self) -> None:
        """The same where nobody waits: after Ctrl-C, or if the worker does not answer."""
        self.close()


class Worker(ABC):
    """One that computes.

    Attributes:
        name: for messages.
        lost: whether it has been given up: it may stand still, and to wait for it again would take as long again.
        told: whether the user knows that.
    """

    name: str
    lost: bool = False
    told: bool = False

    @abstractmethod
    def make(self, kind: type[Part], memory: int | None, given: Sequence[Any]) -> Future[Held]:
        """Make a part.

        Args:
            kind: its class, see :class:`Part`.
            memory: bytes of the device's memory that may be filled with views; None: the part's own default.
            given: the rest of what it is made with; a :class:`Shared` among it stands for what was shared.
        """


@dataclass(frozen=True)
class Shared:
    """Something large that all workers have, given to them once.

    Attributes:
        handle: by which the pool knows it.
        part: what of it a worker uses: its method ``subset`` is given this there. None: all of it.
    """

    handle: Any
    part: Any = None

    def of(self, thing: Any) -> Any:
        """What a worker uses of the thing that this stands for."""
        return thing if self.part is None else thing.subset(self.part)


_counting = threading.Lock()


class Went(NamedTuple):
    """What went for one purpose: how many answers came, and the bytes either way."""

    answers: int = 0
    sent: int = 0
    received: int = 0


@dataclass
class Traffic:
    """What went between the master and the workers, in bytes: arrays, without what their transport adds.

    Attributes:
        sent, received: in all.
        of: the same by what it was for: a command of the parts, or the kind of a thing that was shared.
    """

    sent: int = 0
    received: int = 0
    of: dict[str, Went] = field(default_factory=dict)

    def add(self, sent: int = 0, received: int = 0, what: str | None = None, answers: int = 0) -> None:
        """Count what has gone, from any thread."""
        with _counting:
            self.sent += sent
            self.received += received
            if what is not None:
                before = self.of.get(what, Went())
                self.of[what] = Went(before.answers + answers, before.sent + sent, before.received + received)


class Pool(Owner, ABC):
    """Workers that share a work.

    Attributes:
        first: the master's own device.
        in_process: whether workers are threads of this process. Then the master does a share of the work on its device,
            and what lies on a device can be lent (:mod:`potr_cl.opencl.relay`): it goes to another one without a stay
            on the host. Others send what has changed, and not all of it.
        patience: seconds, or ten times as long as the others took if that is longer, after which a worker that alone
            has not answered counts as lost; None: workers are waited for.
    """

    first: Device
    in_process: bool = False
    traffic: Traffic
    patience: float | None = None

    @abstractmethod
    def workers(self) -> list[Worker]:
        """Those that have not been lost; without the master.

        Raises:
            WorkerLost: none is left.
        """

    @property
    def devices(self) -> Sequence[Device]:
        """Devices of this process that workers have, without the master's."""
        return ()

    def reserve(self) -> list[Worker]:
        """Who does the work of lost workers when none is left."""
        return []

    @contextmanager
    def shared(self, thing: Any) -> Iterator[Shared]:
        """Give something to all workers once, for parts that are made as long as the context lasts.

        Threads see what the master sees. Others are sent it when they first make a part of it, and keep it for the
        parts that follow.
        """
        yield Shared(thing)

    def has(self, thing: Any) -> bool:
        """Whether all workers have something that was shared with them, so that it is not sent again."""
        return self.in_process

    @abstractmethod
    def close(self) -> None:
        """Leave the workers; none of them goes on working for this pool."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """What all that compute views are called, those that have been lost too."""


@dataclass(frozen=True)
class Shares:
    """Who does which views.

    Attributes:
        own: numbers of the master's views. others: of each part's; none is empty.
        names: of the workers that the parts are meant for, in the same order.
    """

    own: list[int]
    others: list[list[int]]
    names: tuple[str, ...] = ()


def shares(pool: Pool, views: int, own_speed: float = 1.0) -> Shares:
    """Share so many views out to a pool.

    Args:
        own_speed: of the master against a worker, if it takes part.

    Raises:
        WorkerLost: no worker is left.
    """
    workers = pool.workers()
    speeds = [*([own_speed] if pool.in_process else []), *[1.0] * len(workers)]
    dealt = deal(views, speeds)
    own, others = (dealt[0], dealt[1:]) if pool.in_process else ([], dealt)
    busy = [(worker, each) for worker, each in zip(workers, others, strict=True) if each]
    return Shares(own, [each for _, each in busy], tuple(worker.name for worker, _ in busy))


def deal(views: int, speeds: Sequence[float]) -> list[list[int]]:
    """Numbers of views for each of several workers, ascending, in proportion to their speeds.

    Neighbours go to different workers: views that lie near each other take about the same time. A worker gets none
    where there are fewer views than workers.

    Args:
        speeds: of the workers, above 0.
    """
    shares: list[list[int]] = [[] for _ in speeds]
    for view in range(views):
        # The first of those that would be done earliest.
        best = min(range(len(speeds)), key=lambda place: (len(shares[place]) + 1) / speeds[place])
        shares[best].append(view)
    return shares
