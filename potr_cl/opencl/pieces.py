"""Launches cut to pieces that end in time, where a display's watchdog would end a longer one: :class:`Pieces`.

How long work-groups take is measured by the host's clock while kernels run, since not every device has another: a
kernel that is not known begins with a small piece, which is waited for, and the next are as large as its time allows.
A launch that is known to be short goes through whole, unmeasured but for every few of them; many short ones are waited
for together before they would make a long one.

What is cut is the range of work-items: pieces have an offset (OpenCL 1.1). Kernels ask for their work-group by
``GROUP_ID`` of cl/include/group.clh, which counts through all pieces; those that ask for the size of the range
are not cut along that dimension.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from math import prod
from pathlib import Path
from time import perf_counter

import pyopencl as cl

from potr_cl.opencl.source import kernel_source

#: Of the allowed time, what a piece should take: the next work-groups may have more to do than the last.
_AIM = 0.4
#: A piece has at most so many times the work-groups of the one before, and of a launch's at most one part in so many.
_GROWTH, _PARTS = 4, 16
#: What is left of the slowest piece's rate at the next launch; below this part of the aim a piece tells of overhead.
_MEMORY, _TELLING = 0.9, 1 / 16
#: Work-groups of a first piece for each compute unit; how many launches of a short kernel go unmeasured.
_FIRST, _UNMEASURED = 2, 15
#: Work-items of the smallest piece where the driver chooses work-groups.
_OWN_GROUP = 256

Size = tuple[int, ...]
#: A kernel's file, its name, and the files that stand in for others (:func:`potr_cl.opencl.source.kernel_source`).
Declared = tuple[str, str, tuple[tuple[str, Path], ...]]


@cache
def uncut(kernel: Declared) -> frozenset[int]:
    """Dimensions along which a kernel must not be cut: it asks how large the range is."""
    source, name, variants = kernel
    text = re.sub(r"/\*.*?\*/|//[^\n]*", " ", kernel_source(source, dict(variants)), flags=re.DOTALL)
    body = next(part for part in re.split(r"\bkernel\b", text) if re.match(r"[^;{]*\bvoid\s+" + name + r"\s*\(", part))
    return frozenset(int(d) for d in re.findall(r"get_(?:global_size|num_groups)\((\d)\)", body))


@dataclass
class _Known:
    """Of a kernel: seconds a work-group in whole launches and in the slowest pieces, and launches until it is measured
    again."""

    rate: float
    slowest: float
    unmeasured: int


@dataclass
class Pieces:
    """Cuts the launches of one device.

    Args:
        seconds: that a piece may take.
        compute_units: of the device.

    Attributes:
        longest: seconds of the longest piece of each kernel. cut: how many launches of each were cut.
    """

    seconds: float
    compute_units: int
    longest: dict[str, float] = field(default_factory=dict)
    cut: dict[str, int] = field(default_factory=dict)
    _known: dict[Declared, _Known] = field(default_factory=dict)
    _pending: float = 0.0

    def launch(
        self,
        enqueue: Callable[[Size, Size], None],
        queue: cl.CommandQueue,
        kernel: Declared,
        items: Size,
        group: Size | None,
    ) -> None:
        """Enqueue a range, in as many pieces as it needs.

        Args:
            enqueue: takes a piece's work-items and its offset.
            queue: it enqueues to.
            kernel: where it is declared.
            items: work-items, and group: of a work-group.
        """
        unit = group or (min(_OWN_GROUP, items[0]), *items[1:])
        grid = tuple(-(-n // u) for n, u in zip(items, unit, strict=True))
        known, total, aim = self._known.get(kernel), prod(grid), _AIM * self.seconds
        is_short = known is not None and known.rate * total <= aim / 2
        if known is not None and is_short and known.unmeasured > 0:
            known.unmeasured -= 1
            if self._pending + known.rate * total > aim:
                queue.finish()
                self._pending = 0.0
            self._pending += known.rate * total
            enqueue(items, (0,) * len(items))
            return
        queue.finish()
        self._pending = 0.0
        walk = _Walk(grid, uncut(kernel))
        pieces, whole, name = 0, 0.0, kernel[1]
        slowest = 0.0 if known is None else _MEMORY * known.slowest
        count = total if is_short else _FIRST * self.compute_units
        while not walk.done:
            place, size = walk.next(max(count, 1))
            offset = tuple(p * u for p, u in zip(place, unit, strict=True))
            wide = tuple(min(s * u, n - o) for s, u, n, o in zip(size, unit, items, offset, strict=True))
            began = perf_counter()
            enqueue(wide, offset)
            queue.finish()
            took = perf_counter() - began
            self.longest[name] = max(took, self.longest.get(name, 0.0))
            whole += took
            pieces += 1
            rate = took / prod(size)
            if took >= _TELLING * aim:
                slowest = max(rate, slowest)
            count = int(min(aim / max(rate, slowest, 1e-12), _GROWTH * prod(size), total / _PARTS))
        rate = whole / max(total, 1)
        self._known[kernel] = _Known(rate if known is None else max(rate, known.rate / 2), slowest, _UNMEASURED)
        self.cut[name] = self.cut.get(name, 0) + (pieces > 1)


class _Walk:
    """Pieces of a grid, the first dimension running fastest; whole dimensions are taken in one."""

    def __init__(self, grid: Size, whole: frozenset[int]) -> None:
        self._grid, self._whole = grid, whole
        self._place = [0] * len(grid)
        self.done = not prod(grid)

    def next(self, count: int) -> tuple[Size, Size]:
        """Place and size of a piece of about so many work-groups, at least of one."""
        count //= prod(self._grid[d] for d in self._whole if d < len(self._grid))
        size: list[int] = []
        lower_are_full = True
        for d, n in enumerate(self._grid):
            if d in self._whole:
                size.append(n)
                continue
            size.append(max(min(n - self._place[d], count), 1) if lower_are_full else 1)
            lower_are_full &= size[-1] == n
            count //= size[-1]
        place = tuple(self._place)
        for d, n in enumerate(self._grid):
            self._place[d] += size[d]
            if self._place[d] < n:
                return place, tuple(size)
            self._place[d] = 0
        self.done = True
        return place, tuple(size)
