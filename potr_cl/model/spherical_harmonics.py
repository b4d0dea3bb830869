"""Colours as functions of the direction: the harmonics that 3DGS uses (:func:`ac_basis`), and how strongly a colour
differs from its mean in a direction (:func:`energy`).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
_Floats = TypeVar("_Floats", NDArray[np.float32], NDArray[np.float64])

#: Norm of a splat's AC coefficients, of all channels, below which there are none to speak of.
_NONE = 1e-4


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


def unit_coefficients(ac: NDArray[np.floating]) -> F64:
    """AC coefficients (K, M - 1, 3) of unit norm, a splat's together; zero where there are none to speak of."""
    colours: F64 = ac.astype(np.float64)
    norm = np.sqrt((colours**2).sum(axis=(1, 2)))
    colours *= np.where(norm > _NONE, 1 / np.maximum(norm, _NONE), 0)[:, None, None]
    return colours


def energy(rays: F64, colours: _Floats) -> _Floats:
    """(n,) squared deviation of colours from their mean over all directions, each in its own direction.

    Training moves coefficients along the basis functions of its views' directions, so this deviation, averaged over
    many splats, is large in directions from which they were looked at.

    Args:
        rays: (n, 3) from the camera to the splats, of any length.
        colours: (n, M - 1, 3) AC coefficients.
    """
    towards = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-300)[:, None]
    basis = ac_basis(towards)[:, : colours.shape[1]].astype(colours.dtype, copy=False)
    deviation = np.einsum("km,kmc->kc", basis, colours)
    squared: _Floats = np.einsum("kc,kc->k", deviation, deviation)
    return squared
