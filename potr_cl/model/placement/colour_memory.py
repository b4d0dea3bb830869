"""Colours remember from where they were trained: how well do those of a scene remember a place?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.placement.matter import Matter
from potr_cl.model.placement.sampling import F64
from potr_cl.model.spherical_harmonics import energy

F32 = NDArray[np.float32]

#: Targets with coefficients to speak of, below which that is not asked.
_INFORMATIVE = 100


def remembered(places: F64, shown: list[F32], matter: Matter) -> F64 | None:
    """(places,) how well the colours of what one sees from a place remember a view from there; None: they cannot tell.

    It is the energy of the visible splats' colours towards the place, as a part of what the same splats have towards
    the best places. (Training moves coefficients along the basis functions of its views' directions, so their squared
    deviation, averaged over many splats, follows the density of the views.)
    """
    informative = matter.colours.any(axis=(1, 2))
    # A function of the first degree alone varies as much away from a view as towards it.
    if matter.colours.shape[1] < 8 or np.count_nonzero(informative) < _INFORMATIVE:
        return None
    energies = np.stack([energy(matter.targets - place, matter.colours) for place in places])
    weights = np.stack(shown) * informative
    total = np.maximum(weights.sum(axis=1), 1e-6)
    own = (weights * energies).sum(axis=1) / total
    best = np.quantile(weights @ energies.T / total[:, None], 0.95, axis=1)
    remembered: F64 = own / np.maximum(best, 1e-12)
    return remembered
