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
    sh: FloatArray,
    worth: FloatArray | None,
    bytes_a_coefficient: int,
    other_bytes: int,
    request: Request,
    to_target: bool = False,
) -> int:
    """The SH degree up to which the coefficients are kept.

    To leave out a degree saves bytes of all splats, as to remove some splats does. It is worth it if it costs less
    error than the splats of as many bytes would, each of which may cost ``delta_mse_max``. That alone would give up the
    highlights of a few splats for the bytes of all, and the file would look worse than other files of the same q. So
    all that goes must also cost no more than what those give up: single coefficients, each where it is not worth its
    bytes.

    Args:
        sh: (N, M, 3) coefficients.
        worth: as of :meth:`potr_cl.outputs.output.Output.fix_ac`; None: nobody knows, so the degree stays.
        bytes_a_coefficient: of all three channels.
        other_bytes: of a splat, its geometry and its constant coefficients.
        request: whose parameters say what a splat may cost.
        to_target: only the worth of bytes counts, because somebody has asked for a size or a PSNR.
    """
    degree = SH_COEFFICIENTS.index(sh.shape[1])
    if worth is None:
        return degree
    limit = request.parameters.delta_mse_max
    price = limit * bytes_a_coefficient / (other_bytes + bytes_a_coefficient * (sh.shape[1] - 1))

    def errors_of(start: int) -> NDArray[np.float64]:
        some = slice(start, start + _BLOCK)
        each = worth[some] * np.square(sh[some]).sum(axis=2)
        return np.stack([each.sum(axis=0, dtype=np.float64), np.minimum(each, price).sum(axis=0, dtype=np.float64)])

    with thread_pool(request.threads) as pool:
        errors, given_up = sum(pool.map(errors_of, range(0, len(sh), _BLOCK)), np.zeros((2, sh.shape[1])))
    left = np.inf if to_target else given_up[1:].sum()
    while degree > 0:
        first, end = SH_COEFFICIENTS[degree - 1], SH_COEFFICIENTS[degree]
        splat = other_bytes + bytes_a_coefficient * (end - 1)
        removed = len(sh) * bytes_a_coefficient * (end - first) / splat
        cost = errors[first:end].sum()
        if cost > min(limit * removed, left):
            break
        left -= cost
        degree -= 1
    return degree
