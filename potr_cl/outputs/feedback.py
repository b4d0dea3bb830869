"""AC coefficients rounded one after another, each making up for the ones before: :func:`rounded_in_turn`.

The coefficients of a splat are not independent of each other: what one is wrong by, others can take back in the
directions from which the views look. So the last coefficient is rounded first; the others are moved to where the error
of the splat's colours is least then; and so on down to the constant one, which is left as it comes out. This is the
nearest-plane method (Babai: "On Lovász' lattice reduction and the nearest lattice point problem", 1986) with the
splat's own block of the re-fit's normal equations as the measure.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np

from potr_cl.codec.native import quantising
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

#: Added to a block's diagonal, as a part of its mean: what no view tells apart is not moved far.
DAMPING = 1e-2
#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 13

#: Rounds coefficient m of some splats: called with m, the wanted values (3, n) and which splats they are of, returns
#: the values (3, n) that the file can hold.
Quantise = Callable[[int, FloatArray, slice], FloatArray]


def rounded_in_turn(sh: FloatArray, packed: FloatArray, quantise: Quantise, threads: int = 0) -> FloatArray:
    """Coefficients that a file can hold, close to the given ones in how they look.

    Args:
        sh: (N, M, 3).
        packed: (M (M + 1) / 2, N) float32, the upper triangles of the splats' blocks, row by row: what squared errors
            of one channel's coefficients cost.
        quantise: rounds.
        threads: to work with; the result does not depend on it. 0: one a processor.

    Returns:
        (N, M, 3) float32; the constant ones are moved, but not rounded.
    """
    found = np.empty_like(sh)
    count = sh.shape[1]
    packed = np.ascontiguousarray(packed)
    own = threading.local()

    def turn(start: int) -> None:
        rows = slice(start, start + _BLOCK)
        if not hasattr(own, "room"):
            own.room = np.empty((3, count, 3, min(_BLOCK, len(sh))), np.float32)
        given, moved, part = own.room[..., : len(sh[rows])]
        columns = unit_factors(packed, rows)
        given[:] = moved[:] = sh[rows].transpose(1, 2, 0)
        for m in range(count - 1, 0, -1):
            held = quantise(m, moved[m], rows)
            np.multiply(columns[m * (m - 1) // 2 :][:m, None], given[m] - held, out=part[:m])
            moved[:m] += part[:m]
            moved[m] = held
        found[rows] = moved.transpose(2, 0, 1)

    with thread_pool(threads) as pool:
        list(pool.map(turn, range(0, len(sh), _BLOCK)))
    return found


@definition
def unit_factors(packed: FloatArray, splats: slice) -> FloatArray:
    """(M (M − 1) / 2, n): above their diagonals, column by column, the unit upper triangles U with Uᵀ D U = block.

    So the last coefficient's own part stands apart from all others'. All splats take one step together: that is several
    times as quick as a routine for one small matrix after another.

    Args:
        packed: (M (M + 1) / 2, N) as of :func:`rounded_in_turn`, in C order.
        splats: which of them.
    """
    count = math.isqrt(2 * len(packed))
    some = packed[:, splats]
    columns = np.empty((count * (count - 1) // 2, some.shape[1]), np.float32)
    factor = np.empty((count, count, some.shape[1]), np.float32)
    factor[np.triu_indices(count)] = some
    size = factor[0, 0].copy()
    for m in range(1, count):
        size += factor[m, m]
    size /= np.float32(count)
    for m in range(count):
        factor[m, m] += np.float32(DAMPING) * size
        factor[m, m][size <= np.float32(1e-30)] = 1
    product = np.empty((count, some.shape[1]), np.float32)
    for m in range(count - 1):
        row = factor[m, m + 1 :] / factor[m, m]
        for k in range(m + 1, count):
            np.multiply(factor[m, k:], row[k - m - 1], out=product[k:])
            factor[k, k:] -= product[k:]
            columns[k * (k - 1) // 2 + m] = row[k - m - 1]
    return columns


def _unit_factors_by_c(c: CFunctions, packed: FloatArray, splats: slice) -> FloatArray:
    count = math.isqrt(2 * len(packed))
    columns = np.empty((count * (count - 1) // 2, packed[:, splats].shape[1]), np.float32)
    quantising.unit_factors(c, packed, splats.start, DAMPING, columns)
    return columns
