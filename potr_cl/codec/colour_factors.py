"""What colours need of a file's other properties: :class:`ColourFactors`, their scale factors and classes of steps.

Several threads that make values of a file's integers share one, and whoever comes first computes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.byte_planes import IntegerStream
from potr_cl.codec.container import Header
from potr_cl.codec.native.library import native
from potr_cl.codec.steps.rule import ColourSteps, factors

F32 = NDArray[np.float32]
I8 = NDArray[np.int8]
T = TypeVar("T")

#: Splats whose classes are computed at a time.
_BLOCK = 1 << 15
#: The native path takes levels below.
_MOST_MEDIUM = 1 << 29


class Once(Generic[T]):
    """A value that is computed when it is first asked for; other threads that ask meanwhile wait.

    Args:
        compute: makes it. What it raises is raised to all who ask.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self._compute = compute
        self._lock = Lock()
        self._made: list[T] = []

    def get(self) -> T:
        """The value."""
        with self._lock:
            if not self._made:
                self._made.append(self._compute())
            return self._made[0]


@dataclass(frozen=True)
class ColourFactors:
    """Scale factors of a file's colours, by what its splats show.

    Attributes:
        classes: (N,) classes of the steps of DC.
        dc, ac: float32 scale factors, (N,), or (1,) if all are the same.
    """

    classes: I8
    dc: F32
    ac: F32

    @staticmethod
    def of(
        header: Header,
        steps: ColourSteps | None,
        scales: Callable[[], list[IntegerStream]],
        opacities: Callable[[], IntegerStream],
    ) -> ColourFactors:
        """Find them.

        Args:
            header: has the scale factors of class 0.
            steps: the file's, or None where it has none.
            scales, opacities: give the streams of these properties; asked only if there are steps.
        """
        splats = header.splats
        if steps is None:
            return ColourFactors(np.zeros(splats, np.int8), factors(header.sf_dc), factors(header.sf_ac))
        by_axis, opacity = scales(), opacities()
        functions = native()
        if functions is not None and (joined := _medium([*by_axis, opacity])) is not None:
            dc, ac = functions.step_classes(steps, joined[:3], joined[3])
            return ColourFactors(dc, factors(header.sf_dc, dc), factors(header.sf_ac, ac))
        dc, ac = np.empty(splats, np.int8), np.empty(splats, np.int8)
        for start in range(0, splats, _BLOCK):
            stop = min(start + _BLOCK, splats)
            levels = [stream.part(start, stop) for stream in by_axis]
            dc[start:stop], ac[start:stop] = steps.classes(levels, opacity.part(start, stop), start)
        return ColourFactors(dc, factors(header.sf_dc, dc), factors(header.sf_ac, ac))

    def of_rows(self, rows: NDArray[np.int64]) -> ColourFactors:
        """Those of some splats."""
        dc, ac = (each[rows] if len(each) > 1 else each for each in (self.dc, self.ac))
        return ColourFactors(self.classes[rows], dc, ac)


def _medium(streams: Sequence[IntegerStream]) -> NDArray[np.int32] | None:
    """(streams, N) levels as the native path takes them; None if they are too large."""
    joined = [stream.joined for stream in streams]
    if any(levels.dtype.itemsize > 1 and int(levels.max(initial=0)) >= _MOST_MEDIUM for levels in joined):
        return None
    return np.stack(joined, dtype=np.int32, casting="unsafe")
