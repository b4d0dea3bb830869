"""Vectors as rows of floats in which a weighted distance is a product of two rows.

A point x has a weight w_g for each group g of coordinates (an SH coefficient: its R, G and B). Its distance to a
centre, the sum over groups of w_g |x_g − c_g|², is a constant of the point plus the product of [w, −2 w x] and
[|c|², c].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray

#: Floats in a row are a multiple of this.
QUARTER = 4


def width_of(groups: int, coordinates: int) -> int:
    """Floats in a row of vectors of so many groups of so many coordinates."""
    return -(-groups * (1 + coordinates) // QUARTER) * QUARTER


def rows_of_points(points: FloatArray, weights: FloatArray) -> FloatArray:
    """(N, width) float32, C order.

    Args:
        points: (N, G, C).
        weights: (N, G).
    """
    n, groups, coordinates = points.shape
    rows = np.zeros((n, width_of(groups, coordinates)), np.float32)
    rows[:, :groups] = weights
    weighted = rows[:, groups : groups * (1 + coordinates)].reshape(n, groups, coordinates)
    np.multiply(points, weights[:, :, None] * np.float32(-2), out=weighted)
    rows[:, groups : groups * (1 + coordinates)] = weighted.reshape(n, -1)
    return rows


def rows_of_centres(centres: FloatArray) -> FloatArray:
    """(K, width) float32, C order.

    Args:
        centres: (K, G, C).
    """
    count, groups, coordinates = centres.shape
    rows = np.zeros((count, width_of(groups, coordinates)), np.float32)
    rows[:, :groups] = np.square(centres.astype(np.float64)).sum(axis=2)
    rows[:, groups : groups * (1 + coordinates)] = centres.reshape(count, -1)
    return rows


def centres_of_sums(sums: FloatArray, centres: FloatArray) -> FloatArray:
    """(K, G, C), the weighted means of clusters; where nothing has any weight, a centre stays.

    Args:
        sums: (K, width), of the rows of each cluster's points.
        centres: (K, G, C), those before.
    """
    count, groups, coordinates = centres.shape
    mass = sums[:, :groups, None].astype(np.float64)
    weighted = sums[:, groups : groups * (1 + coordinates)].reshape(count, groups, coordinates)
    return np.where(mass > 0, -0.5 * weighted / np.where(mass > 0, mass, 1), centres).astype(np.float32)


def errors_at_zero(points: FloatArray, weights: FloatArray) -> NDArray[np.float64]:
    """(N,) the constant of each point: its distance to zero."""
    errors: NDArray[np.float64] = np.einsum("ngc,ngc,ng->n", points, points, weights, dtype=np.float64, optimize=False)
    return errors
