"""Spherical harmonics in turned axes (:func:`rotated_sh`): what colours become when a scene is rotated."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray

#: Coefficients worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16


def rotated_sh(sh: FloatArray, rotation: NDArray[np.float64]) -> FloatArray:
    """SH coefficients of a scene that is rotated about the origin.

    A colour that was seen in the direction d is then seen in the direction R d. Each degree's coefficients are
    multiplied by a matrix (Wigner's D for real harmonics), which is solved for from the harmonics themselves: from more
    directions than it has rows, in float64.

    Args:
        sh: (N, M, 3) float32, M = 1, 4, 9 or 16.
        rotation: (3, 3) float64, orthonormal, of determinant 1.

    Returns:
        (N, M, 3) float32; the first coefficient is that of ``sh``.
    """
    turned = sh.copy()
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = _harmonics(directions), _harmonics(directions @ rotation)
    for first, end in itertools.pairwise(SH_COEFFICIENTS):
        if sh.shape[1] < end:
            break
        matrix = np.linalg.lstsq(here[:, first:end], there[:, first:end], rcond=None)[0]
        for start in range(0, len(sh), _BLOCK):
            rows = slice(start, start + _BLOCK)
            turned[rows, first:end] = np.einsum("ij,njc->nic", matrix, sh[rows, first:end])
    return turned


def _harmonics(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 16) values of the harmonics that 3DGS uses, with the signs of Kerbl et al. 2023, for (n, 3) unit vectors."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    values = [
        np.full_like(x, np.sqrt(1 / (4 * np.pi))),
        *(np.sqrt(3 / (4 * np.pi)) * part for part in (-y, z, -x)),
        *(np.sqrt(15 / (4 * np.pi)) * part for part in (x * y, -y * z)),
        np.sqrt(5 / (16 * np.pi)) * (2 * zz - xx - yy),
        *(np.sqrt(15 / (4 * np.pi)) * part for part in (-x * z, (xx - yy) / 2)),
        -np.sqrt(35 / (32 * np.pi)) * y * (3 * xx - yy),
        np.sqrt(105 / (4 * np.pi)) * x * y * z,
        -np.sqrt(21 / (32 * np.pi)) * y * (4 * zz - xx - yy),
        np.sqrt(7 / (16 * np.pi)) * z * (2 * zz - 3 * xx - 3 * yy),
        -np.sqrt(21 / (32 * np.pi)) * x * (4 * zz - xx - yy),
        np.sqrt(105 / (16 * np.pi)) * z * (xx - yy),
        -np.sqrt(35 / (32 * np.pi)) * x * (xx - 3 * yy),
    ]
    return np.stack(values, axis=1)
