"""The process of a program: signals (:func:`end_cleanly_on_signals`), its standard files, which whoever started it may
have closed (:func:`open_standard_files`), and its end (:func:`end_at_once`).

Told to end by Ctrl-C, ``kill`` or a closed terminal, it ends soon and leaves nothing behind. Only programs call this,
never the library: a process that uses the library has its own way with signals. A program calls
:func:`end_cleanly_on_signals` first of all, and does its work in :func:`unwinding`. What can end early with a result
that is of use asks in :func:`first_interrupt_asks` whether it should. Few imports: until signals are handled, Ctrl-C
ends in a traceback.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from types import FrameType

from potr_cl.host import leftovers

# As typing has it, which takes long to import.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import BinaryIO

_SAID = {
    "SIGINT": b"potr-cl: interrupted; no file is left half written\n",
    "SIGBREAK": b"potr-cl: interrupted; no file is left half written\n",  # Ctrl-Break on Windows
    "SIGTERM": b"potr-cl: terminated; no file is left half written\n",
    "SIGHUP": b"potr-cl: the terminal was closed; no file is left half written\n",
}
#: Seconds that the work is given to let go of what it holds.
PATIENCE = 5.0

#: What the first Ctrl-C is answered by work that can end early.
_ENDS_EARLY = b"potr-cl: interrupted: finishing with the result so far; press Ctrl-C again to abort\n"

_main = _thread.get_ident()
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
    signals do what they did before. A block within another one is asked, and the other is not. In other
    threads than the main one nobody asks.

    Yields:
        To be looked at now and then: whether the work was asked to end.
    """
    global _asked
    if _thread.get_ident() != _main:
        yield Asked()
        return
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


#: Descriptors that were closed when the process began: what is to go there or come from there is refused.
closed: set[int] = set()


def open_standard_files() -> None:
    """Have all three lead somewhere, if only to nowhere, and note those that were :data:`closed`.

    Otherwise the next file that is opened takes the number of the one that is missing, and what libraries print ends up
    in it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            closed.add(descriptor)
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (as long as the process)
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


@contextmanager
def standard_output_for_data() -> Iterator[BinaryIO]:
    """Standard output as a stream of bytes that nobody else writes to.

    Until the block ends, what this process prints there, and what libraries and drivers print there, which do not ask
    Python, goes to standard error.
    """
    ordinary = sys.stdout
    ordinary.flush()
    try:
        descriptor = ordinary.fileno()
    except (OSError, ValueError):  # no file of the system: within another program
        with redirect_stdout(sys.stderr):
            yield ordinary.buffer
        return
    kept = os.dup(descriptor)
    try:
        os.dup2(2, descriptor)
        stream = os.fdopen(os.dup(kept), "wb")
        try:
            with redirect_stdout(sys.stderr):
                yield stream
        except BaseException:
            with suppress(OSError):  # of what could not be written, which has been told
                stream.close()
            raise
        stream.close()
    finally:
        os.dup2(kept, descriptor)
        os.close(kept)


def end_at_once(code: int) -> None:
    """End the process, and let the system take back what drivers and Python would give back piece by piece.

    That takes as long as to open the drivers, and helps nobody. What was registered to be done at the end is done.
    While other threads still work, or somebody watches the process (a profiler, a debugger), or where what was written
    cannot be flushed, nothing happens: an ordinary end waits, lets them finish, or says what is wrong.

    Args:
        code: the exit code.
    """
    import atexit
    import threading

    others = any(thread is not threading.current_thread() and not thread.daemon for thread in threading.enumerate())
    if others or _watched():
        return
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        return
    atexit._run_exitfuncs()
    os._exit(code)


def _watched() -> bool:
    monitoring = getattr(sys, "monitoring", None)  # since Python 3.12
    tools = [] if monitoring is None else [monitoring.get_tool(number) for number in range(6)]
    return sys.gettrace() is not None or sys.getprofile() is not None or any(tools)
