"""Float64 definition of the SH energy compaction: a splat at a time with scipy's least squares, or many at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np
from numpy.typing import NDArray

from potr_cl.stages.compaction.view_weights import ViewWeights
from tests.reference.raster import sh_basis

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
    """(M,) coefficients that minimise :func:`objective`, zero where not ``used``.

    Raises:
        ImportError: scipy is not installed.
    """
    import scipy.linalg

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


# ------------------------------------------------------------------------------------------------ many splats at a time


def triangles(
    means: Array, centres: Array, weights: ViewWeights, degree: int, at_a_time: int = 2048
) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """R of the QR factorisation of :func:`weighted_basis`, splats of like numbers of views together.

    Yields:
        Numbers of splats that some view sees, (n,), and their triangles (n, M, M): they stand for the bases, whose
        products with a vector have the same norm.
    """
    counts = np.diff(weights.offsets)
    order = np.argsort(counts, kind="stable")[np.count_nonzero(counts == 0) :]
    count = (degree + 1) ** 2
    for start in range(0, len(order), at_a_time):
        splats = order[start : start + at_a_time]
        longest = max(int(counts[splats].max()), count)
        columns = np.arange(longest)
        valid = columns < counts[splats, None]
        entries = np.where(valid, weights.offsets[splats, None] + columns, 0)
        directions = means[splats, None] - centres[weights.views[entries]]
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
        basis = sh_basis(directions.reshape(-1, 3), degree).reshape(len(splats), longest, count)
        basis *= np.where(valid, weights.weights[entries], 0)[..., None]
        yield splats, cast(Array, np.linalg.qr(basis, mode="r"))


def usable_columns_of(triangle: Array, alpha: float) -> Mask:
    """:func:`usable_columns` of many bases, (n, M), by their triangles."""
    products = np.swapaxes(triangle, 1, 2) @ triangle
    norms = np.sqrt(np.diagonal(products, axis1=1, axis2=2))
    usable: Mask = norms > 0
    if alpha < 1:
        for i in range(1, triangle.shape[2]):
            parallel = np.abs(products[:, i, :i]) > alpha * norms[:, i, None] * norms[:, :i]
            usable[:, i] &= ~(parallel & usable[:, :i]).any(axis=1)
    return usable


class Ridges:
    """One channel of many splats: the regression over the coefficients ``used`` (n, M), by orthogonal factors.

    Args:
        triangle, original: (n, M, M), (n, M).
    """

    def __init__(self, triangle: Array, original: Array, used: Mask, lam: float) -> None:
        count = original.shape[1]
        penalty = np.full(count, np.sqrt(lam))
        penalty[0] = 0
        # A coefficient that is not used gets a row of its own, which says that it is zero.
        rows = np.where(used, penalty, 1)[:, :, None] * np.eye(count)
        self._matrix = np.concatenate([triangle * used[:, None], rows], axis=1)
        self._right = np.zeros((len(original), 2 * count))
        self._right[:, :count] = np.einsum("nij,nj->ni", triangle[:, :, 1:], original[:, 1:])
        self._q, self._r = np.linalg.qr(self._matrix)
        self._original, self._used = original, used

    def solution(self) -> Array:
        """(n, M), as :func:`ridge`."""
        x: Array = np.linalg.solve(self._r, np.einsum("nij,ni->nj", self._q, self._right)[..., None])[..., 0]
        x *= self._used
        x[:, 0] += self._original[:, 0]
        return x

    def excess(self, x: Array) -> tuple[Array, Array]:
        """:func:`objective` at ``x`` above the optimum, and the optimum, each (n,).

        The excess is the squared part of the residual that the matrix can reach, no difference of two objectives.
        """
        shifted = x * self._used
        shifted[:, 0] -= self._original[:, 0]
        residual = np.einsum("nij,nj->ni", self._matrix, shifted) - self._right
        reached = np.einsum("nij,ni->nj", self._q, residual)
        rest = residual - np.einsum("nij,nj->ni", self._q, reached)
        return np.sum(reached**2, axis=1), np.sum(rest**2, axis=1)
