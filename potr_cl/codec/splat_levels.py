"""Values of splats to the levels of a file: scales, rotations and opacities (:func:`splat_levels`), and colours
(:func:`colour_levels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.native import quantising
from potr_cl.codec.quantisers import QUANTISERS, Balanced
from potr_cl.codec.steps.rule import factors
from potr_cl.host.threads import Run
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

#: Splats worked on at a time: a few arrays of them fit a second-level cache.
BLOCK = 1 << 14
#: The same for what takes little of a thread's time.
_MANY = 1 << 16

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class SplatLevels:
    """Levels of some splats, each in the smallest of the signed integer types that holds it.

    Attributes:
        scales, rotations: of the three axes, (n,) each.
        opacities: (n,).
    """

    scales: list[quantize.Integers]
    rotations: list[quantize.Integers]
    opacities: quantize.Integers


@definition
def splat_levels(scene: Scene, order: I64, world: quantize.HyperParameters, run: Run = map) -> SplatLevels:
    """Quantise all of some splats but centres and colours, each in its canonical form.

    Args:
        scene: clean.
        order: (n,) numbers of the splats.
        world: parameters in world units.
        run: in place of :func:`map`, to work with several threads.

    Raises:
        DataError: a value too large to quantise.
    """
    rules = QUANTISERS[world.quantiser]
    imaginary, log_scales = _canonical(scene, order, run)
    scales = list(run(lambda part: quantize.quantize_scales(part.astype(np.float64), world.sf_scale), log_scales.T))
    logits = scene.opacity_logits[order].astype(np.float64)
    rotations = rules.quantize_rotations(imaginary, scales, world.sf_rotation, run)
    opacities = rules.quantize_opacities(logits, world.sf_opacity)
    return SplatLevels(scales, list(rotations), opacities)


def _splat_levels_by_c(c: CFunctions, scene: Scene, order: I64, world: quantize.HyperParameters, run: Run = map) -> Any:
    """Not where a level has more than 32 bits, which NumPy has to say or to hold."""
    if not isinstance(QUANTISERS[world.quantiser], Balanced):
        return NotImplemented
    quaternions, logits = (np.ascontiguousarray(each, np.float32) for each in (scene.quaternions, scene.opacity_logits))
    factors = (world.sf_scale, world.sf_rotation, world.sf_opacity)
    levels, sizes = np.empty((7, len(order)), np.int32), np.empty((len(order), 3))

    def exponentials(start: int) -> None:
        # The one function here whose last digit another library could round otherwise.
        part = slice(start, start + _MANY)
        with np.errstate(over="ignore"):
            np.exp(scene.log_scales.take(order[part], axis=0).astype(np.float64), out=sizes[part])

    def quantise(start: int) -> NDArray[np.int32] | None:
        rows = order[start : start + BLOCK]
        own = sizes[start : start + BLOCK]
        return quantising.splat_levels(
            c, quaternions, own, logits, rows, *quantize.AXIS_ROTATIONS, factors, quantize.RANGE_OF_LOGITS, start,
            levels,
        )  # fmt: skip

    list(run(exponentials, range(0, len(order), _MANY)))
    found = list(run(quantise, range(0, len(order), BLOCK)))
    largest = [each for each in found if each is not None]
    if len(largest) < len(found):
        return NotImplemented
    types = [quantize.level_type(float(most)) for most in np.max(largest, axis=0)]
    columns = [levels[k].astype(dtype) for k, dtype in enumerate(types)]
    return SplatLevels(columns[:3], columns[3:6], columns[6])


def _canonical(scene: Scene, order: I64, run: Run) -> tuple[F64, F32]:
    """:func:`potr_cl.codec.quantize.canonical_rotations` in some order."""
    imaginary = np.empty((len(order), 3))
    log_scales = np.empty((len(order), 3), np.float32)

    def turn(start: int) -> None:
        rows = order[start : start + BLOCK]
        block = slice(start, start + len(rows))
        imaginary[block], log_scales[block] = quantize.canonical_rotations(scene.quaternions, scene.log_scales, rows)

    list(run(turn, range(0, len(order), BLOCK)))
    return imaginary, log_scales


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
    levels: NDArray[np.signedinteger] = np.empty((count, 3, len(sh)), np.int16)

    def take(start: int) -> list[_Wide]:
        rows = order[start : start + _BLOCK]
        of_dc, of_ac = (
            # A factor that is the same for all is not rounded: so it is for files without steps.
            factors(scale_factor, part[start : start + len(rows)]) if part.any() else scale_factor
            for scale_factor, part in zip((parameters.sf_dc, parameters.sf_sh), classes, strict=True)
        )
        return quantised(columns, rows, of_dc, of_ac, start, levels)

    wide = [each for some in run(take, range(0, len(sh), _BLOCK)) for each in some]
    if wide:
        levels = levels.astype(np.result_type(*{made.dtype for _, made in wide}))
        for where, made in wide:
            levels[where] = made
    return levels


_Wide = tuple[tuple[int, int, slice], quantize.Integers]
_Factor = float | NDArray[np.float32]


@definition
def quantised(
    columns: FloatArray, rows: NDArray[np.int64], dc: _Factor, ac: _Factor, start: int, levels: NDArray[Any]
) -> list[_Wide]:
    """Levels of some splats' colours.

    Args:
        columns: (M, 3, N) R, G, B.
        rows: (n,) of them.
        dc, ac: scale factors, (n,) or one for all.
        start: where they go in ``levels`` (M, 3, …).

    Returns:
        What does not fit there: where it belongs, and what it is.
    """
    block, wide = slice(start, start + len(rows)), []
    planar = (
        # Coefficients that are contiguous each, as a re-fit leaves them, are picked from each.
        np.array([[column.take(rows) for column in rgb] for rgb in columns])
        if columns.strides[2] == columns.itemsize
        else np.ascontiguousarray(columns.transpose(2, 0, 1)[rows].transpose(1, 2, 0))
    )
    for m, rgb in enumerate(planar):
        for c, values in enumerate(quantize.to_ycocg(rgb.astype(np.float64).T)):
            made = quantize.quantize_sh(values, ac if m else dc)
            if made.dtype == levels.dtype:
                levels[m, c, block] = made
            else:
                wide.append(((m, c, block), made))
    return wide


def _quantised_by_c(
    c: CFunctions, columns: FloatArray, rows: NDArray[np.int64], dc: _Factor, ac: _Factor, start: int,
    levels: NDArray[Any],
) -> Any:  # fmt: skip
    planar, sh = columns.flags.c_contiguous, columns.transpose(2, 0, 1)
    if columns.dtype != np.float32 or not (planar or sh.flags.c_contiguous):
        return NotImplemented
    of_dc, of_ac = (np.broadcast_to(np.asarray(each, np.float64), rows.shape).copy() for each in (dc, ac))
    fit = quantising.colour_levels(c, columns if planar else sh, planar, rows, of_dc, of_ac, start, levels)
    return [] if fit else NotImplemented
