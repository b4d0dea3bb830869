"""Runs of splats: where the items of their streams are coded (:class:`Bundles`, :class:`Layout`), and the integers that
their sections hold (:class:`Levels`).

A *bundle* is a run of splats that needs no other for its decoding, so that bundles are what threads share out. A
stream has some *items* in each bundle: one a splat, or one for each thing that only some splats have. The items of a
bundle are shared out evenly over its lanes, in their order, so that no lane waits for another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

I64 = NDArray[np.int64]

#: Most splats of a lane, and most lanes of a bundle.
LANE, LANES = 256, 32
#: Splats of every bundle but the last.
BUNDLE = LANE * LANES


@dataclass(frozen=True)
class Bundles:
    """The bundles of a run of splats that begins with a bundle.

    Attributes:
        splats: n, at least 1.
    """

    splats: int

    @property
    def number(self) -> int:
        return -(-self.splats // BUNDLE)

    @cached_property
    def lanes(self) -> I64:
        """(bundles,) lanes of each."""
        return -(-np.minimum(self.splats - BUNDLE * np.arange(self.number), BUNDLE) // LANE)

    @cached_property
    def dense(self) -> Layout:
        """Of the streams that have an item for each splat."""
        return self.items(np.arange(self.splats))

    def items(self, splats: NDArray[np.integer]) -> Layout:
        """Of a stream with an item for each of some splats, which are named in order, and may be named repeatedly."""
        return Layout(np.bincount(splats // BUNDLE, minlength=self.number), self.lanes)


@dataclass(frozen=True)
class Layout:
    """Where a stream's items are in rows, one for each step, with 32 columns for each bundle, one for each lane.

    Attributes:
        counts: (bundles,) items of each.
        lanes: (bundles,) lanes of each.
    """

    counts: I64
    lanes: I64

    @cached_property
    def steps(self) -> I64:
        """(bundles,) items of a lane, but for the last ones."""
        return -(-self.counts // self.lanes)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.steps.max(initial=0)), LANES * len(self.counts)

    @cached_property
    def places(self) -> I64:
        """(items,) where each item is in the flattened rows."""
        places, end = np.empty(int(self.counts.sum()), np.int64), 0
        rows = np.arange(self.shape[0]) * self.shape[1]
        for bundle, (count, lanes, steps) in enumerate(zip(self.counts, self.lanes, self.steps, strict=True)):
            columns = LANES * bundle + np.arange(lanes)
            places[end : end + count] = (columns[:, None] + rows[:steps]).ravel()[:count]
            end += count
        return places

    @cached_property
    def idle(self) -> NDArray[np.bool_]:
        """(rows, columns) where no item is."""
        idle = np.ones(self.shape, bool)
        idle.ravel()[self.places] = False
        return idle

    def laid(self, values: NDArray[Any], dtype: type[np.generic] | None = None) -> NDArray[Any]:
        """(items,) to (rows, columns), of another type if one is given; 0 where there is no item."""
        rows = np.zeros(self.shape, dtype or values.dtype)
        rows.ravel()[self.places] = values
        return rows

    def taken(self, rows: NDArray[Any]) -> NDArray[Any]:
        """(rows, columns) to (items,)."""
        return rows.ravel()[self.places]


@dataclass(frozen=True)
class Items:
    """The AC coefficients of which a channel is not 0.

    Attributes:
        splats: (K,) of each, counted from the run's first.
        coefficients: (K,) 1 to 15.
        channels: (3, K) Y, Co, Cg.
    """

    splats: NDArray[Any]
    coefficients: NDArray[Any]
    channels: NDArray[Any]


@dataclass
class Levels:
    """Integers of a run of splats; None for what was not asked for.

    Attributes:
        start, stop: the first splat, and the one behind the last.
        opacities: (n,) not negative.
        scales: of each axis, (n,), not negative.
        rotations: x, y, z, (n,) each.
        dc: Y, Co, Cg of the DC coefficient, (n,) each: what its prediction has left, or the levels themselves.
        ac: items of the degrees asked for, those of each degree in the order of splats.
        dense: of each AC coefficient in turn Y, Co, Cg, (n,) each, where they are not told as items.
        classes: (2, n) int8 classes of the steps of DC and of AC, where they were found.
        predicted: whether DC is what its prediction has left.
    """

    start: int
    stop: int
    opacities: NDArray[Any] | None = None
    scales: list[NDArray[Any]] | None = None
    rotations: list[NDArray[Any]] | None = None
    dc: list[NDArray[Any]] | None = None
    ac: list[Items] = field(default_factory=list)
    dense: list[list[NDArray[Any]]] = field(default_factory=list)
    classes: NDArray[np.int8] | None = None
    predicted: bool = True

    def part(self, start: int, stop: int) -> Levels:
        """Those of some splats, which are counted from this run's first."""
        stop = min(stop, self.stop - self.start)
        own = slice(start, stop)
        part = Levels(self.start + start, self.start + stop, None if self.opacities is None else self.opacities[own])
        for name in ("scales", "rotations", "dc"):
            if (arrays := getattr(self, name)) is not None:
                setattr(part, name, [array[own] for array in arrays])
        part.dense = [[channel[own] for channel in channels] for channels in self.dense]
        part.predicted = self.predicted
        if self.classes is not None:
            part.classes = self.classes[:, own]
        for items in self.ac:
            first, end = np.searchsorted(items.splats, (start, stop))
            some = slice(first, end)
            part.ac.append(Items(items.splats[some] - start, items.coefficients[some], items.channels[:, some]))
        return part

    def coefficient(self, number: int) -> NDArray[Any]:
        """(3, n) Y, Co, Cg of an AC coefficient, zeros included."""
        for items in self.ac:
            (own,) = np.nonzero(items.coefficients == number)
            if len(own):
                channels = items.channels[:, own]
                planes = np.zeros((3, self.stop - self.start), channels.dtype)
                planes[:, items.splats[own]] = channels
                return planes
        return np.zeros((3, self.stop - self.start), np.int8)


def joined(parts: Sequence[Levels]) -> Levels:
    """Levels of some runs of splats, which follow each other and were asked for the same, as those of one run."""
    if len(parts) == 1:
        return parts[0]
    whole = Levels(parts[0].start, parts[-1].stop)
    if parts[0].opacities is not None:
        whole.opacities = np.concatenate([part.opacities for part in parts if part.opacities is not None])
    for name in ("scales", "rotations", "dc"):
        if getattr(parts[0], name) is not None:
            setattr(whole, name, [np.concatenate([getattr(part, name)[k] for part in parts]) for k in range(3)])
    for of_degree in zip(*(part.ac for part in parts), strict=True):
        splats = [items.splats + (part.start - whole.start) for items, part in zip(of_degree, parts, strict=True)]
        whole.ac.append(
            Items(
                np.concatenate(splats),
                np.concatenate([items.coefficients for items in of_degree]),
                np.concatenate([items.channels for items in of_degree], axis=1),
            )
        )
    return whole
