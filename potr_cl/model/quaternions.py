"""Rotations as matrices (:func:`rotation_matrices`) and as quaternions (:func:`quaternions_of`)."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray
from potr_cl.model.spherical_harmonics import ac_basis

F64 = NDArray[np.float64]


def rotation_matrices(quaternions: F64) -> F64:
    """(…, 3, 3) from unit quaternions (…, 4), w first."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions_of(rotations: F64) -> F64:
    """(n, 4) unit quaternions, w first, of rotation matrices (n, 3, 3), each by its largest part."""
    products = np.empty((len(rotations), 4, 4))
    products[:, 1:, 1:] = rotations + rotations.transpose(0, 2, 1)
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        products[:, 0, k + 1] = products[:, k + 1, 0] = rotations[:, b, a] - rotations[:, a, b]
    trace = np.einsum("nii->n", rotations)
    products[:, 0, 0] = 1 + trace
    for k in range(3):
        products[:, k + 1, k + 1] = 1 + 2 * rotations[:, k, k] - trace
    largest = np.einsum("nii->ni", products).argmax(axis=1)
    rows = products[np.arange(len(rotations)), largest]
    quaternions: F64 = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return quaternions


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
