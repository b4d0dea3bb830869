"""Libraries of others: their warnings, which tell users nothing (:func:`without_warnings`), and how to install one that
is missing (:func:`install_command`).

Python has one list of filters for all threads, and :class:`warnings.catch_warnings` puts back the one that it has
found. Where two threads use it at overlapping times, the first to end has the other's warnings shown, and the second
one leaves its own filters behind for good. So all of this package use one block, which is counted.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

#: How often something is tried that warnings have ended (:func:`whatever_warns`).
_TRIES = 10

_lock = threading.Lock()
_silences: list[warnings.catch_warnings[None]] = []
_blocks = 0


@contextmanager
def without_warnings() -> Iterator[None]:
    """Show no warning, of any thread, until the last of all blocks that overlap has ended; then all is as before."""
    global _blocks
    with _lock:
        _blocks += 1
        if _blocks == 1:
            _silences.append(silence := warnings.catch_warnings())
            silence.__enter__()
        # At each entry: others may have put filters of their own in front since the first.
        warnings.simplefilter("ignore")
    try:
        yield
    finally:
        with _lock:
            _blocks -= 1
            if _blocks == 0:
                _silences.pop().__exit__(None, None, None)


def whatever_warns(work: Callable[[], T]) -> T:
    """Call a function that libraries warn in, with no warning shown, even where Python makes errors of warnings.

    A block alone is not enough for a thread: while it is at work, others may put filters in front of the silent ones,
    or put back those that they had found before, and where these turn warnings into errors (``python -W error``) the
    next warning ends the work. It is done again then, from the beginning.

    Args:
        work: may be called several times.

    Raises:
        Whatever ``work`` raises; warnings only if they have ended it many times.
    """
    for _ in range(_TRIES - 1):
        try:
            with without_warnings():
                return work()
        except Warning:
            continue
    with without_warnings():
        return work()


def install_command(extra: str) -> str:
    """What a user types to get what an extra of this package brings.

    Where the package is installed, pip takes the extra's libraries from its metadata: no index need know the package.

    Args:
        extra: its name in pyproject.toml.
    """
    # Imported where something is missing: it takes longer than most of this package's own modules.
    from importlib.metadata import PackageNotFoundError, version

    try:
        version("potr-cl")
    except PackageNotFoundError:  # a clone that is run without being installed
        return f'pip install ".[{extra}]" in a clone of the repository'
    return f'pip install "potr_cl[{extra}]"'
