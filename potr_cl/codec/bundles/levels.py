"""What the sections of coder BUNDLES hold of a run of splats, as integers: :class:`Levels`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

I64 = NDArray[np.int64]


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
