"""Colours as functions of the direction: the harmonics that 3DGS uses (:func:`ac_basis`), how strongly a colour differs
from its mean in a direction (:func:`energy`), and what rotations do to them (:func:`rotated_sh`).
"""

from __future__ import annotations

import itertools
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray
from potr_cl.native.declarations import CFunctions, address
from potr_cl.native.table import definition

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


@definition
def energy(rays: F64, colours: _Floats) -> _Floats:
    """(n,) squared deviation of colours from their mean over all directions, each in its own direction.

    Training moves coefficients along the basis functions of its views' directions, so this deviation, averaged over
    many splats, is large in directions from which they were looked at.

    Args:
        rays: (n, 3) from the camera to the splats, of any length.
        colours: (n, M - 1, 3) AC coefficients.
    """
    x, y, z = rays.T
    towards = rays / np.maximum(np.sqrt(x * x + y * y + z * z), 1e-300)[:, None]
    basis = ac_basis(towards).astype(colours.dtype, copy=False)
    deviation = np.zeros((len(colours), 3), colours.dtype)
    for m in range(colours.shape[1]):
        deviation += basis[:, m, None] * colours[:, m]
    red, green, blue = deviation.T
    squared: _Floats = red * red + green * green + blue * blue
    return squared


def _energy_by_c(c: CFunctions, rays: F64, colours: _Floats) -> Any:
    n, count = len(rays), colours.shape[1]
    if colours.dtype != np.float32 or count > 15 or not (rays.flags.c_contiguous and colours.flags.c_contiguous):
        return NotImplemented
    energies = np.empty(n, np.float32)
    c["potr_energies"](
        address(rays, np.float64, 3 * n),
        n,
        address(colours, np.float32, 3 * count * n),
        count,
        address(energies, np.float32, n, True),
    )
    return energies


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
