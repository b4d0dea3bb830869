"""What the sections of coder BUNDLES hold of a run of splats, as integers: :class:`Levels`."""

from __future__ import annotations

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
        dc: Y, Co, Cg of the DC coefficient, (n,) each.
        ac: items of the degrees asked for, those of each degree in the order of splats.
    """

    start: int
    stop: int
    opacities: NDArray[Any] | None = None
    scales: list[NDArray[Any]] | None = None
    rotations: list[NDArray[Any]] | None = None
    dc: list[NDArray[Any]] | None = None
    ac: list[Items] = field(default_factory=list)
