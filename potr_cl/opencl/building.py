"""Who builds which program at a time: :func:`building`."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Hashable, Iterator
from contextlib import contextmanager

from potr_cl.host.silence import without_warnings

_turns = threading.Lock()
#: Held by who builds or loads a program, by the program; of all programs of CPUs there is one.
_locks: defaultdict[Hashable, threading.Lock] = defaultdict(threading.Lock)


@contextmanager
def building(program: Hashable, alone: bool) -> Iterator[None]:
    """Build or load a program, while nobody else does the same one; others are built at the same time.

    Of several devices of a kind the second one then finds what the first one has built. Warnings are not shown
    meanwhile: some drivers chat unasked, and a full disk stops no build.

    Args:
        program: what names it.
        alone: whether no other program may be built at a time: the compilers of CPUs have threads of their own, and
            not all of them may be called by several.
    """
    with _turns:
        lock = _locks[None if alone else program]
    with lock, without_warnings():
        yield
