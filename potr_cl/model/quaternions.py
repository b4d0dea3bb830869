"""Rotations as matrices (:func:`rotation_matrices`) and as quaternions (:func:`quaternions_of`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
