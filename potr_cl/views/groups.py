"""Views that are looked at with the same splats: :class:`ViewGroup`. Pure NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ViewGroup:
    """Views, and the splats that they are looked at with: all, those of some cells, or those of some bits.

    Attributes:
        numbers: of the views among all.
        count: how many splats these are.
        cells: (G,) the groups of the scene's splats (:class:`potr_cl.model.splat_groups.SplatGroups`); None: not so.
        among, bits: a bit for each of the splats of these numbers, ascending, packed; no bits: all of them. None: not
            so.
        nbytes: what the views are known to take if they stay on the device.
        most: how many of them are prepared together at most, as a plan has it; 0: as many as one launch does.
    """

    numbers: tuple[int, ...]
    count: int
    cells: NDArray[np.bool_] | None = None
    among: Indices | None = field(default=None, repr=False)
    bits: NDArray[np.uint8] | None = field(default=None, repr=False)
    nbytes: int = 0
    most: int = 0

    @property
    def splats(self) -> Indices:
        """(count,) their numbers in the scene, ascending."""
        assert self.among is not None, "the splats are known on the device alone"
        return self.among if self.bits is None else self.among[self.mask]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Which of :attr:`among` they are."""
        assert self.among is not None
        if self.bits is None:
            return np.ones(len(self.among), bool)
        return np.unpackbits(self.bits, count=len(self.among)).view(bool)


def work(groups: Sequence[ViewGroup]) -> int:
    """Splats that all views project, each those of its group."""
    return sum(len(group.numbers) * group.count for group in groups)
