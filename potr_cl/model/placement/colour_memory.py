"""Colours remember from where they were trained: how well do those of a scene remember a place?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.placement.matter import Matter
from potr_cl.model.placement.sampling import F64

F32 = NDArray[np.float32]

#: Targets with coefficients to speak of, below which that is not asked.
_INFORMATIVE = 100


def remembered(places: F64, shown: list[F32], matter: Matter) -> F64 | None:
    """(places,) how well the colours of what one sees from a place remember a view from there; None: they cannot tell.

    It is the energy of the visible splats' colours towards the place, as a part of what the same splats have towards
    the best places. (Training moves coefficients along the basis functions of its views' directions, so their squared
    deviation, averaged over many splats, follows the density of the views.)

    Args:
        places: (P, 3) positions in the frame's units.
        shown: (K,) of each place, what can be seen of each target from there, 0 to 1.
        matter: of the scene.
    """
    memory = ColourMemory(places, matter)
    if not memory.tells:
        return None
    return np.array([memory.of(place, visible) for place, visible in zip(places, shown, strict=True)])


class ColourMemory:
    """What colours remember, measured against some places that they are known, or thought, to be seen from.

    Args:
        places: (P, 3) positions in the frame's units.
        matter: of the scene.

    Attributes:
        tells: whether the colours can tell anything.
    """

    def __init__(self, places: F64, matter: Matter) -> None:
        self._matter = matter
        self._informative = matter.colours.any(axis=(1, 2))
        # A function of the first degree alone varies as much away from a view as towards it.
        self.tells = matter.colours.shape[1] >= 8 and np.count_nonzero(self._informative) >= _INFORMATIVE
        self._energies = np.stack([_energy(place, matter) for place in places]) if self.tells else None

    def of(self, place: F64, shown: F32) -> float:
        """How well they remember a place, (3,), from where ``shown``, (K,), is seen; see :func:`remembered`."""
        assert self._energies is not None
        weights = shown * self._informative
        total = max(float(weights.sum()), 1e-6)
        own = float(weights @ _energy(place, self._matter)) / total
        best = float(np.quantile(self._energies @ weights / total, 0.95))
        return own / max(best, 1e-12)


def _energy(camera_centre: F64, matter: Matter) -> F32:
    """(K,) squared deviation of the targets' colours from their mean, seen from ``camera centre``, for coefficients of
    norm 1.
    """
    rays = matter.targets - camera_centre
    towards = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-300)[:, None]
    basis = ac_basis(towards)[:, : matter.colours.shape[1]].astype(np.float32)
    deviation = np.einsum("km,kmc->kc", basis, matter.colours)
    energy: F32 = np.einsum("kc,kc->k", deviation, deviation)
    return energy


def ac_basis(d: F64) -> F64:
    """(n, 15) real spherical harmonics of degree 1 to 3 in unit directions (n, 3), order and signs of 3DGS."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        axis=1,
    )
