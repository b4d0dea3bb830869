"""Colours remember from where they were trained: how well do those of a scene remember a place?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.placement.matter import Matter
from potr_cl.model.placement.sampling import F64
from potr_cl.model.spherical_harmonics import energy

F32 = NDArray[np.float32]

#: Targets with coefficients to speak of, below which that is not asked.
_INFORMATIVE = 100


class ColourMemory:
    """What colours remember, measured against some places that they are known, or thought, to be seen from.

    That is the energy of the visible splats' colours towards a place, as a part of what the same splats have towards
    the best of those places. (Training moves coefficients along the basis functions of its views' directions, so their
    squared deviation, averaged over many splats, follows the density of the views.)

    Args:
        places: (P, 3) positions in the frame's units.
        matter: of the scene.
        run: in place of :func:`map`, to work with several threads.

    Attributes:
        tells: whether the colours can tell anything.
    """

    def __init__(self, places: F64, matter: Matter, run: Run = map) -> None:
        self._matter = matter
        self._informative = matter.colours.any(axis=(1, 2))
        # A function of the first degree alone varies as much away from a view as towards it.
        self.tells = matter.colours.shape[1] >= 8 and np.count_nonzero(self._informative) >= _INFORMATIVE
        self._energies = np.stack(list(run(self._energy, places))) if self.tells else None

    def of(self, place: F64, shown: F32) -> float:
        """How well they remember a place, (3,), from where ``shown``, (K,), is seen, 0 to 1."""
        weights = shown * self._informative
        total = max(float(weights.sum()), 1e-6)
        own = float(weights @ self._energy(place)) / total
        return own / self._best(weights, total)

    def of_known(self, number: int, shown: F32) -> float:
        """The same of one of the places that are known, by its number."""
        assert self._energies is not None
        weights = shown * self._informative
        total = max(float(weights.sum()), 1e-6)
        return float(weights @ self._energies[number]) / total / self._best(weights, total)

    def _best(self, weights: F32, total: float) -> float:
        """How well the best of the known places are remembered by the same splats."""
        assert self._energies is not None
        # Without BLAS, whose threads would wait for each other where several threads ask.
        best = float(np.quantile(np.einsum("pk,k->p", self._energies, weights) / total, 0.95))
        return max(best, 1e-12)

    def _energy(self, place: F64) -> F32:
        """(K,) of the targets' colours, as they are seen from a place."""
        return energy(self._matter.targets - place, self._matter.colours)
