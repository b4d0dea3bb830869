"""Scales, rotations and opacities of splats to the levels of a file: :func:`splat_levels`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.native.functions import Functions
from potr_cl.codec.native.table import definition
from potr_cl.codec.quantisers import QUANTISERS, Balanced
from potr_cl.host.threads import Run
from potr_cl.model.scene import Scene

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


def _splat_levels_by_c(
    functions: Functions, scene: Scene, order: I64, world: quantize.HyperParameters, run: Run = map
) -> Any:
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
        return functions.quantising.splat_levels(
            quaternions, own, logits, rows, *quantize.AXIS_ROTATIONS, factors, quantize.RANGE_OF_LOGITS, start, levels
        )

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
