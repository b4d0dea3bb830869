"""The SH degree of a file whose coefficients all take the same bytes: :func:`worthwhile_degree`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray
from potr_cl.outputs.output import Request

#: Splats worked on at a time.
_BLOCK = 1 << 14


def worthwhile_degree(
    sh: FloatArray, worth: FloatArray | None, bytes_a_coefficient: int, other_bytes: int, request: Request
) -> int:
    """The SH degree up to which the coefficients are worth their bytes.

    To leave out a degree saves bytes of all splats, as to remove some splats does. So it goes if that costs less error
    than the splats of as many bytes would, each of which may cost ``delta_mse_max``.

    Args:
        sh: (N, M, 3) coefficients.
        worth: as of :meth:`potr_cl.outputs.output.Output.fix_ac`; None: nobody knows, so the degree stays.
        bytes_a_coefficient: of all three channels.
        other_bytes: of a splat, its geometry and its constant coefficients.
        request: whose parameters say what a splat may cost.
    """
    degree = SH_COEFFICIENTS.index(sh.shape[1])
    if worth is None:
        return degree

    def error(start: int) -> NDArray[np.float64]:
        some = slice(start, start + _BLOCK)
        errors: NDArray[np.float64] = (worth[some] * np.square(sh[some]).sum(axis=2)).sum(axis=0, dtype=np.float64)
        return errors

    with thread_pool(request.threads) as pool:
        errors = sum(pool.map(error, range(0, len(sh), _BLOCK)), np.zeros(sh.shape[1]))
    while degree > 0:
        first, end = SH_COEFFICIENTS[degree - 1], SH_COEFFICIENTS[degree]
        splat = other_bytes + bytes_a_coefficient * (end - 1)
        removed = len(sh) * bytes_a_coefficient * (end - first) / splat
        if errors[first:end].sum() > request.parameters.delta_mse_max * removed:
            break
        degree -= 1
    return degree
