"""A process that is told to end, by Ctrl-C, ``kill`` or a closed terminal, ends at once and leaves nothing behind.

Only programs call this, never the library: a process that uses the library has its own way with signals.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from types import FrameType

from potr_cl.host import leftovers

_SAID = {
    "SIGINT": b"potr-cl: interrupted; no file is left half written\n",
    "SIGTERM": b"potr-cl: terminated; no file is left half written\n",
    "SIGHUP": b"potr-cl: the terminal was closed; no file is left half written\n",
}


def end_cleanly_on_signals() -> None:
    """Have SIGINT, SIGTERM and SIGHUP remove temporary files, say one line, and exit with 128 and the signal's number.

    Signals that whoever started the process has it ignore (``nohup``) stay ignored.
    """
    for name in _SAID:
        number = getattr(signal, name, None)  # Windows has not all of them
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, _frame: FrameType | None) -> None:
    # No exception is raised: within an import or a library's callback it may be swallowed, or become another one.
    for name in _SAID:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    leftovers.remove_all()
    with suppress(OSError):  # the terminal may be gone
        os.write(2, (b"\n" if os.isatty(2) else b"") + _SAID[signal.Signals(number).name])
    os._exit(128 + number)
