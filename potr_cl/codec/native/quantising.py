"""The C functions of the encoder's loops over all splats, for NumPy arrays (quantise.c).

They give the same bits as NumPy, may be called from several threads at a time, and leave the interpreter free.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from potr_cl.native.declarations import CFunctions, address

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


def nearest(c: CFunctions, points: F32, others: F64, out: F64) -> None:
    """The least distance of each point to the others.

    Args:
        points: (n, 3). others: (v, 3).
        out: (n,), filled.
    """
    c["potr_nearest"](
        address(points, np.float32, 3 * len(out)),
        len(out),
        address(others, np.float64, 3 * len(others)),
        len(others),
        address(out, np.float64, len(out), True),
    )


def canonical(
    c: CFunctions,
    quaternions: F32,
    log_scales: F32,
    order: I64,
    group: F64,
    permutations: U8,
    imaginary: F64,
    turned: F32,
) -> None:
    """The equivalent form of some splats whose unit quaternion has the largest real part.

    Args:
        quaternions: (rows, 4). log_scales: (rows, 3).
        order: (n,) of the rows.
        group: (4, 24) quaternions of the axes' rotations, conjugated. permutations: (24, 3), of the scales.
        imaginary, turned: (n, 3), filled with imaginary parts and log scales.
    """
    rows, number = len(quaternions), len(order)
    if number and not 0 <= int(order.min()) <= int(order.max()) < rows:
        raise TypeError("the native path was given splats that are not there")
    if int(permutations.max()) > 2:
        raise TypeError("the native path was given axes that are not there")
    c["potr_canonical"](
        address(quaternions, np.float32, 4 * rows),
        address(log_scales, np.float32, 3 * rows),
        address(order, np.int64, number),
        number,
        address(group, np.float64, 24 * 4),
        address(permutations, np.uint8, 24 * 3),
        address(imaginary, np.float64, 3 * number, True),
        address(turned, np.float32, 3 * number, True),
    )


def splat_levels(
    c: CFunctions, quaternions: F32, sizes: F64, logits: F32, order: I64, group: F64, permutations: U8,
    factors: tuple[float, float, float], range_of_logits: tuple[float, float], start: int,
    levels: NDArray[np.int32],
) -> NDArray[np.int32] | None:  # fmt: skip
    """Levels of the scales, rotations and opacities of some splats, as version 2 of the format has them.

    Args:
        quaternions, group, permutations: as of :meth:`canonical`.
        sizes: (n, 3) standard deviations. logits: (rows,) of opacities.
        order: (n,) of the rows.
        factors: scale factors of scales, rotations and opacities.
        range_of_logits: the least one, from which they are counted, and the largest.
        levels: (7, stride) of three scales, three rotations, opacities; ``start`` to ``start + n`` are set.

    Returns:
        (7,) the largest magnitude of each; None if one does not fit, and what was set means nothing.
    """
    rows, number, stride = len(logits), len(order), levels.shape[1]
    if number and not 0 <= int(order.min()) <= int(order.max()) < rows:
        raise TypeError("the native path was given splats that are not there")
    if int(permutations.max()) > 2:
        raise TypeError("the native path was given axes that are not there")
    if len(levels) != 7 or not 0 <= start <= stride - number:
        raise TypeError("the native path was given columns that are too short")
    largest = np.zeros(7, np.int32)
    fits = c["potr_splat_levels"](
        address(quaternions, np.float32, 4 * rows),
        address(sizes, np.float64, 3 * number),
        address(logits, np.float32, rows),
        address(order, np.int64, number),
        number,
        address(group, np.float64, 24 * 4),
        address(permutations, np.uint8, 24 * 3),
        *factors,
        *range_of_logits,
        stride,
        address(levels, np.int32, 7 * stride, True) + 4 * start,
        address(largest, np.int32, 7, True),
    )
    return largest if fits else None


def colour_levels(
    c: CFunctions, sh: F32, planar: bool, order: I64, dc: F64, ac: F64, start: int, levels: NDArray[np.int16]
) -> bool:
    """Levels of the SH coefficients of some splats in Y, Co, Cg.

    Args:
        sh: (count, 3, N) in R, G, B if ``planar``, else (N, count, 3); C order.
        order: (n,) numbers of the splats.
        dc, ac: (n,) scale factors.
        levels: (count, 3, stride), of which ``start`` to ``start + n`` are set.

    Returns:
        Whether all fit; if not, what was set means nothing.
    """
    number = len(order)
    count, splats = (sh.shape[0], sh.shape[2]) if planar else (sh.shape[1], sh.shape[0])
    stride = levels.shape[2]
    if number and not 0 <= int(order.min()) <= int(order.max()) < splats:
        raise TypeError("the native path was given splats that are not there")
    if not 0 <= start <= stride - number:
        raise TypeError("the native path was given columns that are too short")
    steps = (1, 3 * splats, splats) if planar else (3 * count, 3, 1)
    fit: int = c["potr_colour_levels"](
        address(sh, np.float32, 3 * splats * count),
        *steps,
        count,
        address(order, np.int64, number),
        number,
        address(dc, np.float64, number),
        address(ac, np.float64, number),
        start,
        stride,
        address(levels, np.int16, 3 * stride * count, True),
    )
    return bool(fit)


def predicted(c: CFunctions, levels: I64, classes: NDArray[np.int8], run: int, steps: I64, inverses: I64) -> I64:
    """What the prediction of DC leaves, :func:`potr_cl.codec.steps.prediction.to_residuals`.

    Args:
        levels: (channels, n).
        classes: (n,), -32 to 31.
        run: splats after which prediction begins anew.
        steps, inverses: (64,) of each class.
    """
    channels, number = levels.shape
    residuals = np.empty((channels, number), np.int64)
    if run < 1:
        raise TypeError("the native path was given runs without a splat")
    c["potr_predicted"](
        address(levels, np.int64, channels * number),
        channels,
        number,
        run,
        address(classes, np.int8, number),
        address(steps, np.int64, 64),
        address(inverses, np.int64, 64),
        address(residuals, np.int64, channels * number, True),
    )
    return residuals


def unit_quaternions(c: CFunctions, quaternions: F32) -> F32:
    """(n, 4) float32 quaternions of unit length, of (n, 4); those of length 0 become the identity."""
    number = len(quaternions)
    units = np.empty((number, 4), np.float32)
    c["potr_unit_quaternions"](
        address(quaternions, np.float32, 4 * number), number, address(units, np.float32, 4 * number, True)
    )
    return units


def nonzero_levels(c: CFunctions, sh: F32, factor: float, most: float) -> NDArray[np.bool_] | None:
    """Which coefficients, in Y, Co, Cg, have a level other than 0.

    Args:
        sh: (n, count, 3) in R, G, B.
        factor: scale factor of the quantiser.
        most: no level may be as large.

    Returns:
        (count, 3, n); None if a level is as large, or no number.
    """
    number, count, _ = sh.shape
    columns = np.empty((count, 3, number), np.uint8)
    sound = c["potr_nonzero_levels"](
        address(sh, np.float32, 3 * number * count),
        number,
        count,
        factor,
        most,
        address(columns, np.uint8, columns.size, True),
    )
    return columns.view(np.bool_) if sound else None


def unit_factors(c: CFunctions, packed: F32, first: int, damping: float, columns: F32) -> None:
    """Unit upper triangles of some splats' blocks (:mod:`potr_cl.outputs.feedback`).

    Args:
        packed: (M (M + 1) / 2, N), the blocks' upper triangles, row by row.
        first: of the splats.
        damping: added to the diagonals, as a part of their mean.
        columns: (M (M − 1) / 2, n), filled with what stands above the diagonals, column by column.
    """
    triangle, number = columns.shape
    count = (1 + math.isqrt(1 + 8 * triangle)) // 2
    rows, splats = packed.shape
    if count > 16 or rows != triangle + count or not 0 <= first <= first + number <= splats:
        raise TypeError("the native path was given blocks that are not there")
    c["potr_unit_factors"](
        address(packed, np.float32, rows * splats),
        splats,
        first,
        number,
        count,
        damping,
        address(columns, np.float32, triangle * number, True),
    )
