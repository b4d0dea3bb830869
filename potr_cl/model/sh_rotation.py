"""Spherical harmonics in turned axes (:func:`rotated_sh`): what colours become when a scene is rotated."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray
from potr_cl.model.spherical_harmonics import ac_basis

#: Coefficients worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16


def rotated_sh(sh: FloatArray, rotation: NDArray[np.float64]) -> FloatArray:
    """SH coefficients of a scene that is rotated about the origin.

    A colour that was seen in the direction d is then seen in the direction R d. Each degree's coefficients are
    multiplied by a matrix (Wigner's D for real harmonics), which is solved for from the harmonics themselves: from more
    directions than it has rows, in float64.

    Args:
        sh: (N, M, 3) float32, M = 1, 4, 9 or 16.
        rotation: (3, 3) float64, orthonormal; of determinant -1 it mirrors.

    Returns:
        (N, M, 3) float32; the first coefficient is that of ``sh``.
    """
    turned = sh.copy()
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = ac_basis(directions), ac_basis(directions @ rotation)
    for first, end in itertools.pairwise(SH_COEFFICIENTS):
        if sh.shape[1] < end:
            break
        matrix = np.linalg.lstsq(here[:, first - 1 : end - 1], there[:, first - 1 : end - 1], rcond=None)[0]
        for start in range(0, len(sh), _BLOCK):
            rows = slice(start, start + _BLOCK)
            turned[rows, first:end] = np.einsum("ij,njc->nic", matrix, sh[rows, first:end])
    return turned
