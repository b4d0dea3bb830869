"""What Python takes of the memory: :func:`takes_at_most`; and what is taken of a device's: :func:`taken_of`."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from potr_cl.opencl.device import Device


@contextmanager
def takes_at_most(nbytes: float) -> Iterator[None]:
    """That a block never has more bytes allocated than before it."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < nbytes
    finally:
        tracemalloc.stop()


@contextmanager
def taken_of(device: Device) -> Iterator[list[tuple[str, int]]]:
    """What memory is taken for inside, and how much of the device's is taken then."""
    taken, allocate = [], device.allocate

    def noted(nbytes, what):
        buffer = allocate(nbytes, what)
        taken.append((what, device.allocated))
        return buffer

    with patch.object(device, "allocate", noted):
        yield taken
