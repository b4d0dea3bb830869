"""Vectors as rows of floats in which a weighted distance is a product of two rows.

A point x has a weight w_g for each group g of coordinates (an SH coefficient: its R, G and B). Its distance to a
centre, the sum over groups of w_g |x_g − c_g|², is a constant of the point plus the product of [w, −2 w x] and
[|c|², c].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray

#: Floats in a row are a multiple of this.
QUARTER = 4
#: Points that a thread works on at a time.
_BLOCK = 1 << 14


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

    def fill(start: int) -> None:
        some = slice(start, start + _BLOCK)
        rows[some, :groups] = weights[some]
        weighted = points[some] * (weights[some, :, None] * np.float32(-2))
        rows[some, groups : groups * (1 + coordinates)] = weighted.reshape(len(weighted), -1)

    with thread_pool() as pool:
        list(pool.map(fill, range(0, n, _BLOCK)))
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
    errors = np.empty(len(points))

    def add(start: int) -> None:
        some = slice(start, start + _BLOCK)
        np.einsum(
            "ngc,ngc,ng->n", points[some], points[some], weights[some], dtype=np.float64, optimize=False,
            out=errors[some],
        )  # fmt: skip

    with thread_pool() as pool:
        list(pool.map(add, range(0, len(points), _BLOCK)))
    return errors
