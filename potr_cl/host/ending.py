"""The end of a process that has done its work: :func:`end_at_once`."""

from __future__ import annotations

import atexit
import os
import sys
import threading


def end_at_once(code: int) -> None:
    """End the process, and let the system take back what drivers and Python would give back piece by piece.

    That takes as long as to open the drivers, and helps nobody. What was registered to be done at the end is done.
    While other threads still work, or where what was written cannot be flushed, nothing happens: an ordinary end waits,
    or says what is wrong.

    Args:
        code: the exit code.
    """
    if any(thread is not threading.current_thread() and not thread.daemon for thread in threading.enumerate()):
        return
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        return
    atexit._run_exitfuncs()
    os._exit(code)
