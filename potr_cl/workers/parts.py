"""The parts of a work, each on a worker: :class:`Parts` gives them commands and makes lost ones again elsewhere.

It keeps a log of the commands that change a part. A worker that dies, stalls or runs out of memory loses its parts;
another one makes them again, and replays the log. As commands give the same results on every worker, nobody else
notices. So do the parts of a worker that is much slower than the others (:mod:`.pace`), in pieces.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures import TimeoutError as NotInTime
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypeAlias

from potr_cl.errors import DeviceError, PotrError
from potr_cl.host.threads import in_background
from potr_cl.opencl.memory import Owner
from potr_cl.workers.pace import Pace, Round
from potr_cl.workers.pool import Held, Part, Pool, Worker, WorkerLost

#: A worker may take so many times as long as the slowest of the others.
_SLOWER = 10

_log = logging.getLogger("potr_cl")


class Parts(Owner):
    """Parts of one work on the workers of a pool.

    Args:
        pool: of the workers.
        kind: of all parts.
        given: what each part is made with, see :class:`potr_cl.workers.pool.Part`.
        memory: bytes of a device's memory that may be filled with views; None: the parts' own default.
        views: how many views each part has: by these, workers' rates are noted in the end.
        names: of the workers that the parts are meant for; those that are lost are replaced by others.

    The workers begin at once; :meth:`ready` waits for them, and so does the first command.
    """

    def __init__(
        self,
        pool: Pool,
        kind: type[Part],
        given: Sequence[Sequence[Any]],
        memory: int | None = None,
        views: Sequence[int] = (),
        names: Sequence[str] = (),
    ) -> None:
        self._views: list[float] = list(views)
        self._longest = 0.0  # seconds that anything has taken
        self._pace = Pace()
        self._pool, self._kind, self._memory = pool, kind, memory
        self._given = [tuple(each) for each in given]
        self._log: list[tuple[str, tuple[Any, ...]]] = []
        self._unfit: set[str] = set()  # workers on which a part of this work has failed
        self._may_relieve = pool.relieves
        self._slow: set[str] = set()  # those whose parts others do
        self._origins = list(range(len(given)))
        self._held: list[Held | None] = [None] * len(self._given)
        self._by: list[Worker | None] = [None] * len(self._given)
        self._making: Round | None = None
        self._pending: Pending | None = None
        self._closing: list[Future[None]] = []
        making: dict[int, Future[Held]] = {}
        try:
            for place, worker in enumerate(_meant(self._able(), names, len(self._given))):
                self._by[place] = worker
                making[place] = worker.make(kind, memory, self._given[place])
            self._making = Round(making)
        except BaseException:
            self._making = Round(making)
            self.close()
            raise

    def ready(self) -> None:
        """Return once all parts are made.

        Raises:
            DeviceError: no worker can make them.
        """
        making, self._making = self._making, None
        if making is not None:
            self._collect(making, self._take_made, None)
            self._pace.note_made(making)

    def __len__(self) -> int:
        return len(self._given)

    def origin(self, place: int) -> int:
        """The number of the part, of those that were given, whose views a part has: a slow worker's may be in pieces.

        The first piece takes the place of the part, others follow behind all parts.
        """
        return self._origins[place]

    # ------------------------------------------------------------------------------------------------ commands

    def begin(self, command: str, *args: Any, logged: bool = True, anew: bool = False) -> Pending:
        """Give all parts a command, and do something else until :meth:`Pending.results`.

        Args:
            command: the parts' method.
            args: of the method, the same for all parts where they are no :class:`Each`.
            logged: whether it changes the parts.
            anew: whether nothing that they were told before matters after it.
        """
        self._settle()
        if anew:
            self._log.clear()
            self._pace.forget_log()
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

        self._collect(Round({place: self._begin(place, command, args)}), take, (command, args))
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
        if self._pool.in_process and self._making is None:
            self._pending = None
            held, self._held = self._held, [None] * len(self._given)
            self._closing = [in_background(each.close) for each in held if each is not None]

    def close(self) -> None:
        """Have the workers forget the parts."""
        self._end(abandoned=False)

    def _end(self, abandoned: bool) -> None:
        self._pending = None
        self._pace.rate([worker for worker in self._by if worker is not None])
        held, self._held = self._held, [None] * len(self._given)
        making, self._making = self._making, None
        for place, each in making.futures.items() if making is not None else ():  # an error came between
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
        return self._send(held, self._origins[place], command, args)

    def _send(self, held: Held, origin: int, command: str, args: Sequence[Any]) -> Future[Any]:
        args = [each.args[origin] if isinstance(each, Each) else each for each in args]
        self._pool.traffic.add(sent=nbytes(args), what=command)
        return held.begin(command, args)

    def _take_made(self, place: int, held: Held) -> None:
        self._held[place] = held

    def _able(self) -> list[Worker]:
        """Workers that have neither been lost nor failed with a part of this work; without any, the reserve.

        Those that are slow are left in peace, unless there are no others.
        """
        for workers in (self._pool.workers, self._pool.reserve):
            able = [worker for worker in workers() if worker.name not in self._unfit]
            if able:
                return [worker for worker in able if worker.name not in self._slow] or able
        return []

    def _collect(self, at: Round, take: Callable[[int, Any], None], command: _Command | None) -> None:
        """Wait for all; where a worker fails, or is slow, have another one do it.

        Args:
            at: what they are at.
            take: is given each place's result, and those of more places where a part is done in pieces.
            command: what they are at; None: they are being made.
        """
        waiting = {future: place for place, future in at.futures.items()}
        failed: list[tuple[int, DeviceError]] = []
        patience, since = self._pool.patience, time.monotonic()
        while waiting:
            slow = self._pace.slow_at(at, since) if self._may_relieve else None
            limits = [] if slow is None else [slow]
            # Nobody can tell how long something takes before one has done it.
            if patience is not None and self._longest > 0:
                limits.append(since + max(patience, _SLOWER * self._longest))
            limit = max(min(limits) - time.monotonic(), 0.0) if limits else None
            done, _ = wait(waiting, limit, return_when=FIRST_COMPLETED)
            if not done and slow is not None and slow <= time.monotonic():
                # If they cannot, it is waited for after all.
                self._may_relieve = self._relieve(waiting, at, take, command)
                continue
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

    def _relieve(
        self, waiting: dict[Future[Any], int], at: Round, take: Callable[[int, Any], None], command: _Command | None
    ) -> bool:
        """Have others do what slow workers are at, in pieces; whether they could."""
        for future, place in list(waiting.items()):
            worker = self._by[place]
            assert worker is not None
            busy = [self._by[each] for each in waiting.values()]
            others = [other for other in self._able() if other not in busy]
            pieces = self._pieces(place, others, command)
            if pieces is None:
                return False
            _log.warning(
                "worker %s is slow: its views go to %s", worker.name, ", ".join(each.by.name for each in pieces)
            )
            left = self._held[place]
            if left is not None:
                left.abandon()
            else:  # it is not made yet: whatever becomes of it, nobody wants it
                future.add_done_callback(_abandon_made)
            del waiting[future]
            self._slow.add(worker.name)
            self._pace.leave(worker, self._views[place] if place < len(self._views) else 0.0, at, place)
            self._put(place, pieces, take, made=command is None)
        return True

    def _pieces(self, place: int, others: Sequence[Worker], command: _Command | None) -> list[_Piece] | None:
        """A part in pieces on other workers, as far as the part itself is, and what they find; None if they cannot."""
        given = self._kind.split(self._given[place], len(others)) if others else []
        pieces: list[_Piece] = []
        makings: list[Future[Held]] = []
        try:
            for each, worker in zip(given, others, strict=False):
                makings.append(worker.make(self._kind, self._memory, each))
            for each, worker, making in zip(given, others, makings, strict=False):
                pieces.append(_Piece(each, worker, self._answer(making)))
            for name, args in [*self._log, *([] if command is None else [command])]:
                answers = [self._send(piece.held, self._origins[place], name, args) for piece in pieces]
                for piece, answer in zip(pieces, answers, strict=True):
                    piece.found = self._answer(answer)
        except DeviceError as error:
            _log.debug("others cannot do the views of a slow worker (%s)", error)
            for making in makings:
                making.add_done_callback(_abandon_made)
            return None
        return pieces or None

    def _put(self, place: int, pieces: Sequence[_Piece], take: Callable[[int, Any], None], made: bool) -> None:
        """Have pieces in the place of a part, and behind all parts."""
        views = self._views[place] / len(pieces) if place < len(self._views) else 0.0
        for number, piece in enumerate(pieces):
            at = place
            if number:
                at = len(self._given)
                self._given.append(())
                self._held.append(None)
                self._by.append(None)
                self._origins.append(self._origins[place])
                if self._views:
                    self._views.append(views)
            elif self._views:
                self._views[place] = views
            self._given[at], self._held[at], self._by[at] = piece.given, piece.held, piece.by
            take(at, piece.held if made else piece.found)

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
            _log.warning("worker %s gave up (%s): its views go to %s", worker.name, last, other.name)
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
        held: Held = self._answer(worker.make(self._kind, self._memory, self._given[place]))
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

    def _note(self, command: str, args: tuple[Any, ...]) -> None:
        self._log.append((command, args))


#: A method of the parts, and what it is given.
_Command: TypeAlias = "tuple[str, Sequence[Any]]"


@dataclass
class _Piece:
    """Some views of a slow worker's part, with another worker; what it found last."""

    given: tuple[Any, ...]
    by: Worker
    held: Held
    found: Any = None


def _is_left(worker: Worker | None) -> bool:
    """Whether nobody waits for a worker any more: another work may have found that it stands still, or is slow."""
    return worker is not None and (worker.lost or worker.is_behind)


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
        args: the parts', in the order in which they were given (:meth:`Parts.origin`).
    """

    args: Sequence[Any]


class Pending:
    """A command that all parts have been given."""

    def __init__(self, parts: Parts, command: str, args: tuple[Any, ...], logged: bool) -> None:
        self._parts, self._command, self._args, self._logged = parts, command, args, logged
        self._at = Round({place: parts._begin(place, command, args) for place in range(len(parts))})
        self._found: list[Any] | None = None

    def results(self) -> list[Any]:
        """What the parts return, in their order, those of pieces behind the others (:meth:`Parts.origin`).

        Raises:
            PotrError: a part refused, or no worker can do it.
        """
        if self._found is not None:
            return self._found
        parts, found, since = self._parts, dict[int, Any](), time.monotonic()

        def take(place: int, result: Any) -> None:
            parts._pool.traffic.add(received=nbytes(result), what=self._command, answers=1)
            found[place] = result

        try:
            parts._collect(self._at, take, (self._command, self._args))
        except BaseException:
            parts._pending = None  # it is over
            raise
        parts._pace.note(self._at, since, self._logged, parts._by, parts._views)
        if self._logged:
            parts._note(self._command, self._args)
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
