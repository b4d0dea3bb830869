"""AC coefficients rounded one after another, each making up for the ones before: :func:`rounded_in_turn`.

The coefficients of a splat are not independent of each other: what one is wrong by, others can take back in the
directions from which the views look. So the last coefficient is rounded first; the others are moved to where the error
of the splat's colours is least then; and so on down to the constant one, which is left as it comes out. This is the
nearest-plane method (Babai: "On Lovász' lattice reduction and the nearest lattice point problem", 1986) with the
splat's own block of the re-fit's normal equations as the measure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray

#: Added to a block's diagonal, as a part of its mean: what no view tells apart is not moved far.
_DAMPING = 1e-2
#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 12

#: Rounds coefficient m of some splats: called with m, the wanted values (n, 3) and which splats they are of, returns
#: the values (n, 3) that the file can hold.
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

    def turn(start: int) -> None:
        rows = slice(start, start + _BLOCK)
        upper = _factors(packed[:, rows], count)
        wanted, error = sh[rows], np.zeros(sh[rows].shape, np.float32)
        for m in range(count - 1, -1, -1):
            own = upper[:, m, m]
            moved = wanted[:, m]
            if m < count - 1:
                moved = moved + np.matmul((upper[:, m, m + 1 :] / own[:, None])[:, None], error[:, m + 1 :])[:, 0]
            held = quantise(m, moved, rows) if m else moved
            error[:, m] = wanted[:, m] - held
            found[rows, m] = held

    with thread_pool(threads) as pool:
        list(pool.map(turn, range(0, len(sh), _BLOCK)))
    return found


def _factors(packed: FloatArray, count: int) -> NDArray[Any]:
    """(n, M, M) upper triangular U with UᵀU = block: the last coefficient's own part stands apart from all others'."""
    rows, columns = np.triu_indices(count)
    blocks = np.empty((packed.shape[1], count, count), np.float32)
    blocks[:, rows, columns] = blocks[:, columns, rows] = packed.T
    diagonal = np.einsum("nmm->nm", blocks)
    size = diagonal.mean(axis=1)
    seen = size > 1e-30
    blocks /= np.where(seen, size, 1)[:, None, None]  # only ratios of the factors are looked at
    blocks[~seen] = 0
    diagonal += np.float32(_DAMPING)
    return np.linalg.cholesky(blocks).transpose(0, 2, 1)
