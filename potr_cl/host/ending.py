"""The end of a process that has done its work: :func:`end_at_once`."""

from __future__ import annotations

import atexit
import os
import sys
import threading


def end_at_once(code: int) -> None:
    """End the process, and let the system take back what drivers and Python would give back piece by piece.

    That takes as long as to open the drivers, and helps nobody. What was registered to be done at the end is done.
    While other threads still work, or somebody watches the process (a profiler, a debugger), or where what was written
    cannot be flushed, nothing happens: an ordinary end waits, lets them finish, or says what is wrong.

    Args:
        code: the exit code.
    """
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
