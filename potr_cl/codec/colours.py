"""A scene's colours as the levels of a file: :func:`colour_levels`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.native.library import native
from potr_cl.codec.steps.rule import factors
from potr_cl.host.threads import Run
from potr_cl.model.scene import FloatArray

#: Splats whose SH coefficients are quantised at a time: few enough for the temporaries to stay in a cache.
_BLOCK = 1 << 14


def colour_levels(
    sh: FloatArray,
    order: NDArray[np.int64],
    parameters: quantize.HyperParameters,
    classes: tuple[NDArray[np.int8], NDArray[np.int8]],
    run: Run,
) -> NDArray[np.signedinteger]:
    """Quantise the colours of a scene.

    Args:
        sh: (N, M, 3) R, G, B in the order of the scene.
        order: (N,) index in the scene of each splat of the file.
        parameters: the scale factors of colours count.
        classes: (N,) of the steps of DC, and of AC, in the order of the file.
        run: in place of :func:`map`, to work with several threads.

    Returns:
        (M, 3, N) levels of the SH coefficients' Y, Co, Cg in the order of the file.

    Raises:
        DataError: a coefficient is too large to quantise.
    """
    count = sh.shape[1]
    columns = sh.transpose(1, 2, 0)
    # Coefficients that are contiguous each, as a re-fit leaves them, are picked from each.
    contiguous = columns.strides[2] == columns.itemsize
    levels: NDArray[np.signedinteger] = np.empty((count, 3, len(sh)), np.int16)
    wide: list[tuple[tuple[int, int, slice], quantize.Integers]] = []

    functions = native()
    whole = columns if columns.flags.c_contiguous else sh if sh.flags.c_contiguous else None

    def take(start: int) -> None:
        rows = order[start : start + _BLOCK]
        block = slice(start, start + len(rows))
        if functions is not None and whole is not None and whole.dtype == np.float32:
            dc, ac = (
                np.full(len(rows), scale_factor, np.float64)
                if not part.any()
                else factors(scale_factor, part[block]).astype(float)
                for scale_factor, part in zip((parameters.sf_dc, parameters.sf_sh), classes, strict=True)
            )
            if functions.quantising.colour_levels(whole, whole is columns, rows, dc, ac, start, levels):
                return
        planar = (
            np.array([[column.take(rows) for column in rgb] for rgb in columns])
            if contiguous
            else np.ascontiguousarray(sh[rows].transpose(1, 2, 0))
        )
        of_dc, of_ac = (
            # A factor that is the same for all is not rounded: so it is for files without steps.
            factors(scale_factor, part[block]) if part.any() else scale_factor
            for scale_factor, part in zip((parameters.sf_dc, parameters.sf_sh), classes, strict=True)
        )
        for m, rgb in enumerate(planar):
            factor = of_ac if m else of_dc
            for c, values in enumerate(quantize.to_ycocg(rgb.astype(np.float64).T)):
                made = quantize.quantize_sh(values, factor)
                if made.dtype == levels.dtype:
                    levels[m, c, block] = made
                else:
                    wide.append(((m, c, block), made))

    list(run(take, range(0, len(sh), _BLOCK)))
    if wide:
        levels = levels.astype(np.result_type(*{made.dtype for _, made in wide}))
        for where, made in wide:
            levels[where] = made
    return levels
