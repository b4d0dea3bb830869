"""What Python takes of the memory: :func:`takes_at_most`."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def takes_at_most(nbytes: float) -> Iterator[None]:
    """That a block never has more bytes allocated than before it."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < nbytes
    finally:
        tracemalloc.stop()
