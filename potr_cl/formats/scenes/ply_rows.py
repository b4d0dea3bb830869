"""The values of binary PLY files, read and put into a scene's arrays by threads: :func:`read_rows`."""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError
from potr_cl.host.threads import Spare, thread_pool
from potr_cl.model.scene import FloatArray

#: Rows that are read at a time: few enough for a cache, and so many that threads seldom wait for the interpreter.
_BLOCK_BYTES = 1 << 22
#: More threads than this wait for memory.
_MOST_THREADS = 16


@dataclass(frozen=True)
class Target:
    """Where some properties of a splat belong.

    Attributes:
        array: (N, k) float32.
        names: of the k properties.
    """

    array: FloatArray
    names: tuple[str, ...]

    def fill(self, start: int, rows: NDArray[np.void]) -> None:
        """Set what rows say, which are those of the splats from ``start`` on."""
        own = self.array[start : start + len(rows)]
        for place, name in enumerate(self.names):
            own[:, place] = rows[name]


def read_rows(
    path: str | os.PathLike[str],
    stream: io.FileIO,
    offset: int,
    dtype: np.dtype[Any],
    count: int,
    targets: Sequence[Target],
) -> None:
    """Fill arrays from rows that stand one after another in a file.

    Args:
        path: of the file, for errors.
        stream: the file, unbuffered.
        offset: where the rows begin.
        dtype: of a row, with a field for each property.
        count: N, the number of rows; the file has been found to be large enough for them.
        targets: the arrays.

    Raises:
        DataError: the file has become shorter.
        OSError: the system failed to read.
    """
    height = max(1, _BLOCK_BYTES // dtype.itemsize)
    starts = range(0, count, height)
    read = _Reader(stream)
    fills = [_quick(target, dtype) or target.fill for target in targets]
    spare = Spare(lambda: np.empty(min(height, count), dtype))

    def one(start: int) -> None:
        with spare.taken() as rows:
            own = rows[: min(height, count - start)]
            got = read(own.view(np.uint8).data, offset + start * dtype.itemsize)
            if got < own.nbytes:
                raise DataError(f"'{path}' is truncated: it ends within splat {start + got // dtype.itemsize}")
            # A float64 beyond float32 becomes infinite, and its splat is dropped with the other non-finite ones.
            with np.errstate(over="ignore"):
                for fill in fills:
                    fill(start, own)

    if len(starts) < 2:
        for start in starts:
            one(start)
        return
    with thread_pool(min(len(starts), os.cpu_count() or 1, _MOST_THREADS)) as pool:
        list(pool.map(one, starts))


class _Reader:
    """Reads from a place in a file, by any thread."""

    def __init__(self, stream: io.FileIO) -> None:
        self._stream, self._lock = stream, threading.Lock()

    def __call__(self, into: memoryview, offset: int) -> int:
        """Fill memory from the bytes at ``offset`` on, unless the file ends before; returns how many there were."""
        got = 0
        while got < len(into):
            n = self._some(into[got:], offset + got)
            if not n:
                break
            got += n
        return got

    def _some(self, into: memoryview, offset: int) -> int:
        if hasattr(os, "preadv"):
            return os.preadv(self._stream.fileno(), [into], offset)
        with self._lock:
            self._stream.seek(offset)
            return self._stream.readinto(into) or 0


def _quick(target: Target, dtype: np.dtype[Any]) -> Any:
    """What :meth:`Target.fill` does, where rows are nothing but floats as they are in memory; None elsewhere."""
    fields: Any = dtype.fields or {}
    if any(kind != np.float32 for kind, *_ in fields.values()) or not target.array.flags.c_contiguous:
        return None
    columns = np.array([fields[name][1] // 4 for name in target.names], np.intp)

    def fill(start: int, rows: NDArray[np.void]) -> None:
        own = target.array[start : start + len(rows)]
        values = rows.view(np.float32).reshape(len(rows), -1)
        values.take(columns, axis=1, out=own, mode="clip")  # without a copy in between

    return fill
