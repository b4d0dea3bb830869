"""The parts of a work, each on a worker: :class:`Parts` gives them commands and makes lost ones again elsewhere.

It keeps a log of the commands that change a part. A worker that dies, stalls or runs out of memory loses its parts;
another one makes them again, and replays the log. As commands give the same results on every worker, nobody else
notices.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures import TimeoutError as NotInTime
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypeAlias

from potr_cl.errors import DeviceError, PotrError
from potr_cl.host.threads import in_background
from potr_cl.opencl.memory import Owner
from potr_cl.workers.pool import Held, Part, Pool, Worker, WorkerLost

#: A worker may take so many times as long as the slowest of the others.
_SLOWER = 10

_log = logging.getLogger("potr_cl")


class Parts(Owner):
    """Parts of one work on the workers of a pool.

    Args:
        given: what each part is made with, see :class:`potr_cl.workers.pool.Part`.
        memory: bytes of a device's memory that may be filled with views; None: the parts' own default.
        names: of the workers that the parts are meant for; those that are lost are replaced by others.

    The workers begin at once; :meth:`ready` waits for them, and so does the first command.
    """

    def __init__(
        self,
        pool: Pool,
        kind: type[Part],
        given: Sequence[Sequence[Any]],
        memory: int | None = None,
        names: Sequence[str] = (),
    ) -> None:
        self._longest = 0.0  # seconds that anything has taken
        self._pool, self._kind, self._budget = pool, kind, memory
        self._given = [tuple(each) for each in given]
        self._log: list[tuple[str, tuple[Any, ...]]] = []
        self._unfit: set[str] = set()  # workers on which a part of this work has failed
        self._held: list[Held | None] = [None] * len(self._given)
        self._by: list[Worker | None] = [None] * len(self._given)
        self._making: dict[int, Future[Held]] = {}
        self._pending: Pending | None = None
        self._closing: list[Future[None]] = []
        try:
            for place, worker in enumerate(_meant(self._able(), names, len(self._given))):
                self._by[place] = worker
                self._making[place] = worker.make(kind, memory, self._given[place])
        except BaseException:
            self.close()
            raise

    def ready(self) -> None:
        """Return once all parts are made.

        Raises:
            DeviceError: no worker can make them.
        """
        making, self._making = self._making, {}
        self._collect(making, self._held.__setitem__, None)

    def __len__(self) -> int:
        return len(self._given)

    # ------------------------------------------------------------------------------------------------ commands

    def begin(self, command: str, *args: Any, logged: bool = True, anew: bool = False) -> Pending:
        """Give all parts a command, and do something else until :meth:`Pending.results`.

        Args:
            args: of the method, the same for all parts where they are no :class:`Each`.
            logged: whether it changes the parts.
            anew: whether nothing that they were told before matters after it.
        """
        self._settle()
        if anew:
            self._log.clear()
        self._pending = Pending(self, command, args, logged)
        return self._pending

    def tell(self, command: str, *args: Any) -> list[Any]:
        """Give all parts a command that changes them; what they return, in their order."""
        return self.begin(command, *args).results()

    def ask(self, place: int, command: str, *args: Any) -> Any:
        """Give one part a command that changes nothing; what it returns."""
        self._settle()
        found: list[Any] = [None]

        def take(_place: int, result: Any) -> None:
            self._pool.traffic.add(received=nbytes(result), what=command, answers=1)
            found[0] = result

        self._collect({place: self._begin(place, command, args)}, take, (command, args))
        return found[0]

    def _settle(self) -> None:
        """Wait for what the parts were told before: the log has commands in their order."""
        self.ready()
        if self._pending is not None:
            self._pending.results()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end(abandoned=kind is not None and not issubclass(kind, Exception))

    def begin_to_close(self) -> None:
        """Have threads of this process forget the parts while the master gives back its own; :meth:`close` waits.

        Drivers take long to give much memory back.
        """
        if self._pool.in_process and not self._making:
            self._pending = None
            held, self._held = self._held, [None] * len(self._given)
            self._closing = [in_background(each.close) for each in held if each is not None]

    def close(self) -> None:
        """Have the workers forget the parts."""
        self._end(abandoned=False)

    def _end(self, abandoned: bool) -> None:
        self._pending = None
        held, self._held = self._held, [None] * len(self._given)
        making, self._making = self._making, {}
        for place, each in making.items():  # an error came between
            if abandoned or _is_left(self._by[place]):
                # Nobody waits for it, and nobody wants it: its memory is given back as soon as it is made.
                each.add_done_callback(_abandon_made)
            else:
                try:
                    held[place] = self._answer(each)
                except WorkerLost:
                    each.add_done_callback(_abandon_made)  # it stands still: when it goes on, nobody wants it
                except PotrError:
                    pass
        for part, by in zip(held, self._by, strict=True):
            if part is not None:
                with suppress(PotrError):
                    part.abandon() if abandoned or _is_left(by) else part.close()
        for closing in self._closing:
            with suppress(PotrError):
                closing.result()
        self._closing = []

    # ------------------------------------------------------------------------------------------------ their parts

    def _begin(self, place: int, command: str, args: Sequence[Any]) -> Future[Any]:
        held, by = self._held[place], self._by[place]
        assert held is not None, "a part is closed"
        if by is not None and by.lost:  # another work has waited for it
            gone: Future[Any] = Future()
            gone.set_exception(WorkerLost("it has been given up before"))
            return gone
        args = [each.args[place] if isinstance(each, Each) else each for each in args]
        self._pool.traffic.add(sent=nbytes(args), what=command)
        return held.begin(command, args)

    def _able(self) -> list[Worker]:
        """Workers that have neither been lost nor failed with a part of this work; without any, the reserve."""
        for workers in (self._pool.workers, self._pool.reserve):
            able = [worker for worker in workers() if worker.name not in self._unfit]
            if able:
                return able
        return []

    def _collect(
        self, at: Mapping[int, Future[Any]], take: Callable[[int, Any], None], command: _Command | None
    ) -> None:
        """Wait for all; where a worker fails, have another one do it.

        Args:
            at: what they will return, by place.
            take: is given each place's result.
            command: what they are at; None: they are being made.
        """
        waiting = {future: place for place, future in at.items()}
        failed: list[tuple[int, DeviceError]] = []
        patience, since = self._pool.patience, time.monotonic()
        while waiting:
            limit = None
            # Nobody can tell how long something takes before one has done it.
            if patience is not None and self._longest > 0:
                limit = max(since + max(patience, _SLOWER * self._longest) - time.monotonic(), 0.0)
            done, _ = wait(waiting, limit, return_when=FIRST_COMPLETED)
            if not done:
                failed += [(place, WorkerLost("it does not answer")) for place in waiting.values()]
                break
            self._longest = max(self._longest, time.monotonic() - since)
            for future in done:
                place = waiting.pop(future)
                try:
                    take(place, future.result())
                except DeviceError as error:
                    failed.append((place, error))
        for place, fault in failed:
            take(place, self._elsewhere(place, fault, command))

    def _elsewhere(self, place: int, error: DeviceError, command: _Command | None) -> Any:
        """Have another worker do what one could not.

        Raises:
            DeviceError: the last one's error, if there is no other.
        """
        last = error
        while True:
            worker = self._by[place]
            assert worker is not None
            self._unfit.add(worker.name)
            worker.lost = worker.lost or isinstance(last, WorkerLost)
            left = self._able()
            if not left:
                raise last
            loads = [sum(by is each for by in self._by) for each in left]
            other = left[loads.index(min(loads))]
            if not worker.told:
                _log.warning("worker %s failed (%s); reassigning its views to %s", worker.name, last, other.name)
                worker.told = worker.lost
            with suppress(PotrError):
                left_behind = self._held[place]
                if left_behind is not None:
                    left_behind.abandon()
            self._held[place], self._by[place] = None, other
            try:
                held = self._remake(place)
                return held if command is None else self._answer(self._begin(place, *command))
            except DeviceError as another:
                last = another

    def _remake(self, place: int) -> Held:
        """Make a part on the worker that has it now, and have it do all that it has been told."""
        worker = self._by[place]
        assert worker is not None
        held: Held = self._answer(worker.make(self._kind, self._budget, self._given[place]))
        self._held[place] = held
        for command, args in self._log:
            self._answer(self._begin(place, command, args))
        return held

    def _answer(self, future: Future[Any]) -> Any:
        """What one part alone is waited for.

        Raises:
            WorkerLost: it takes so much longer than anything has taken by now that its worker must stand still.
        """
        patience = self._pool.patience
        try:
            return future.result(None if patience is None else max(patience, _SLOWER * self._longest))
        except NotInTime:
            raise WorkerLost("it does not answer") from None


#: A method of the parts, and what it is given.
_Command: TypeAlias = "tuple[str, Sequence[Any]]"


def _is_left(worker: Worker | None) -> bool:
    """Whether nobody waits for a worker any more: another work may have found that it stands still."""
    return worker is not None and worker.lost


def _abandon_made(making: Future[Held]) -> None:
    if not making.cancelled() and making.exception() is None:
        with suppress(PotrError):
            making.result().abandon()


def _meant(able: Sequence[Worker], names: Sequence[str], parts: int) -> list[Worker]:
    """The workers for so many parts: those of these names as far as they are able, and others in turn."""
    known = {worker.name: worker for worker in able}
    others = [worker for worker in able if worker.name not in names] or list(able)
    meant = []
    for place in range(parts):
        named = known.get(names[place]) if place < len(names) else None
        if named is None:
            named = others[place % len(others)]
        meant.append(named)
    return meant


@dataclass(frozen=True)
class Each:
    """An argument of a command that is another one for each part.

    Attributes:
        args: the parts', in the order in which they were given.
    """

    args: Sequence[Any]


class Pending:
    """A command that all parts have been given."""

    def __init__(self, parts: Parts, command: str, args: tuple[Any, ...], logged: bool) -> None:
        self._parts, self._command, self._args, self._logged = parts, command, args, logged
        self._at = {place: parts._begin(place, command, args) for place in range(len(parts))}
        self._found: list[Any] | None = None

    def results(self) -> list[Any]:
        """What the parts return, in their order.

        Raises:
            PotrError: a part refused, or no worker can do it.
        """
        if self._found is not None:
            return self._found
        parts, found = self._parts, dict[int, Any]()

        def take(place: int, result: Any) -> None:
            parts._pool.traffic.add(received=nbytes(result), what=self._command, answers=1)
            found[place] = result

        try:
            parts._collect(self._at, take, (self._command, self._args))
        except BaseException:
            parts._pending = None  # it is over
            raise
        if self._logged:
            parts._log.append((self._command, self._args))
        self._found = [found[place] for place in range(len(found))]
        return self._found


def nbytes(thing: Any) -> int:
    """Bytes of the arrays in a thing made of arrays, bytes, lists and tuples."""
    if isinstance(getattr(thing, "nbytes", None), int):
        return int(thing.nbytes)
    if isinstance(thing, (bytes, bytearray, memoryview)):
        return len(thing)
    if isinstance(thing, (list, tuple)):
        return sum(nbytes(each) for each in thing)
    return 8 if isinstance(thing, (int, float)) else 0
