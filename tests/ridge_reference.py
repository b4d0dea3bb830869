"""Float64 definition of the SH energy compaction, one splat at a time, with scipy's least squares."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from tests.reference import sh_basis

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

YCOCG = np.array([[0.25, 0.5, 0.25], [0.5, 0, -0.5], [-0.25, 0.5, -0.25]])


def weighted_basis(mean: Array, centres: Array, weights: Array, degree: int) -> Array:
    """(S, M) SH basis in the directions from the ``centres`` (S, 3) to ``mean``, rows times ``weights`` (S,)."""
    directions = mean - centres
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return sh_basis(directions, degree) * weights[:, None]


def usable_columns(basis: Array, alpha: float) -> Mask:
    """(M,) columns that are not zero and whose |cosine| to every column used before them is at most ``alpha``."""
    norms = np.linalg.norm(basis, axis=0)
    usable: Mask = norms > 0
    if alpha < 1:
        for i in range(1, basis.shape[1]):
            for j in np.flatnonzero(usable[:i]):
                if abs(basis[:, i] @ basis[:, j]) > alpha * norms[i] * norms[j]:
                    usable[i] = False
    return usable


def _stacked(basis: Array, lam: float) -> Array:
    ridge = np.sqrt(lam) * np.eye(basis.shape[1])
    ridge[0, 0] = 0
    return np.concatenate([basis, ridge])


def objective(basis: Array, original: Array, x: Array, lam: float) -> float:
    """What the regression minimises: squared weighted colour error plus lambda times the squared AC coefficients."""
    # Relative to the original's DC, so that float64 is not spent on the sum of two large terms.
    return float(np.sum((basis @ (x - original)) ** 2) + lam * np.sum(x[1:] ** 2))


def ridge(basis: Array, original: Array, used: Mask, lam: float) -> Array:
    """(M,) coefficients that minimise :func:`objective`, zero where not ``used``."""
    x = np.zeros(len(original))
    target = original.copy()
    target[0] = 0
    right = np.concatenate([basis @ target, np.zeros(len(x))])
    # Columns scaled alike: the driver's cut-off of singular values must not depend on their units.
    stacked = _stacked(basis, lam)[:, used]
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0] = 1
    x[used] = scipy.linalg.lstsq(stacked / scale, right, cond=1e-15)[0] / scale
    x[0] += original[0]
    return x


def compact_channel(
    basis: Array, original: Array, lam: float, alpha: float, sf_sh: float, two_pass: bool = True
) -> tuple[Array, Mask]:
    """New coefficients of one channel, and which of them were free in the last pass."""
    used = usable_columns(basis, alpha)
    x = ridge(basis, original, used, lam)
    if two_pass:
        zero = np.floor(0.5 + x * sf_sh) == 0
        zero[0] = False
        used &= ~zero
        x = ridge(basis, original, used, lam)
    return x, used
