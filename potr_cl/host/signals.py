"""A process that is told to end, by Ctrl-C, ``kill`` or a closed terminal, ends soon and leaves nothing behind.

Only programs call this, never the library: a process that uses the library has its own way with signals. A program
calls :func:`end_cleanly_on_signals` first of all, and does its work in :func:`unwinding`. What can end early with a
result that is of use asks in :func:`first_interrupt_asks` whether it should.
"""

from __future__ import annotations

import _thread
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from potr_cl.host import leftovers

_SAID = {
    "SIGINT": b"potr-cl: interrupted; no file is left half written\n",
    "SIGTERM": b"potr-cl: terminated; no file is left half written\n",
    "SIGHUP": b"potr-cl: the terminal was closed; no file is left half written\n",
}
#: Seconds that the work is given to let go of what it holds.
PATIENCE = 5.0

#: What the first Ctrl-C is answered by work that can end early.
_ENDS_EARLY = b"potr-cl: interrupted: finishing with the result so far; press Ctrl-C again to abort\n"

_received: int | None = None
_unwinds = False
_asked: Asked | None = None


class Asked:
    """Whether someone has asked that work ends early; false until then."""

    def __init__(self) -> None:
        self._yes = False

    def __bool__(self) -> bool:
        return self._yes

    def ask(self) -> None:
        """Ask for it."""
        self._yes = True


def end_cleanly_on_signals() -> None:
    """Have SIGINT, SIGTERM and SIGHUP remove temporary files, say one line, and exit with 128 and the signal's number.

    Signals that whoever started the process has it ignore (``nohup``) stay ignored.
    """
    for name in _SAID:
        number = getattr(signal, name, None)  # Windows has not all of them
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


@contextmanager
def unwinding() -> Iterator[None]:
    """Have a signal raise KeyboardInterrupt in the block, so that libraries let go of what they hold, and end it then.

    Outside, a signal ends the process at once: within an import an exception would become another one. Also here it
    ends, whatever becomes of the exception, after a second signal, or if the block has not ended within some seconds.
    Without :func:`end_cleanly_on_signals` this does nothing.
    """
    global _unwinds
    _unwinds = True
    try:
        yield
    finally:
        _unwinds = False
        if _received is not None:
            _end(_received)


@contextmanager
def first_interrupt_asks() -> Iterator[Asked]:
    """Have the first Ctrl-C (SIGINT) in the block do no more than ask the work to end early, and the second one end it.

    Any other signal ends the work at once. Without :func:`end_cleanly_on_signals` this does nothing: nobody asks, and
    signals do what they did before. A block within another one is asked, and the other is not.

    Yields:
        To be looked at now and then: whether the work was asked to end.
    """
    global _asked
    before, _asked = _asked, Asked()
    try:
        yield _asked
    finally:
        _asked = before


def _handle(number: int, _frame: FrameType | None) -> None:
    global _received
    if number == signal.SIGINT and _asked is not None and not _asked and _received is None:
        _asked.ask()
        _tell(_ENDS_EARLY)
        return
    first, _received = _received is None, number
    if not (first and _unwinds):
        _end(number)
    # Not a Thread: its start takes locks, one of which this thread may hold.
    _thread.start_new_thread(_end_late, (number,))
    raise KeyboardInterrupt


def _end_late(number: int) -> None:
    time.sleep(PATIENCE)
    _end(number)


def _end(number: int) -> None:
    leftovers.remove_all()
    _tell(_SAID[signal.Signals(number).name])
    os._exit(128 + number)


def _tell(line: bytes) -> None:
    with suppress(OSError):  # the terminal may be gone
        os.write(2, (b"\n" if os.isatty(2) else b"") + line)
