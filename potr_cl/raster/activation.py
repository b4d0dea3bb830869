"""A scene's parameters as the projection takes them: standard deviations, unit quaternions, logarithms of opacities.

All in float64, to be rounded to float32 once: whoever uploads a scene, by whichever way, gives a device the same bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray

F64 = NDArray[np.float64]

#: Larger standard deviations, in world units, are replaced by this. Nobody can see a difference, and nothing overflows.
LARGEST_SCALE = 1e12


def activated_scales(log_scales: FloatArray) -> F64:
    """(N, 3) standard deviations, world units, of their natural logarithms."""
    return np.minimum(np.exp(np.minimum(log_scales.astype(np.float64), 100)), LARGEST_SCALE)


def unit_quaternions(quaternions: FloatArray) -> F64:
    """(N, 4) quaternions w, x, y, z of unit length, of such of any length; the identity for those of length 0."""
    units = quaternions.astype(np.float64)
    # In this order on every processor, as native/quantise.c has it.
    w, x, y, z = (units * units).T
    length = np.sqrt(w + x + y + z)[:, None]
    nothing = np.flatnonzero(length == 0)
    length[nothing] = 1
    units /= length
    units[nothing] = (1.0, 0.0, 0.0, 0.0)
    return units


def log2_opacities(logits: FloatArray) -> F64:
    """(N,) logarithms to base 2 of the opacities that have these logits, (N,)."""
    wide = logits.astype(np.float64)
    # log(sigmoid(logit)): logaddexp says the same, and takes eight times as long.
    logarithms: F64 = (np.minimum(wide, 0) - np.log1p(np.exp(-np.abs(wide)))) / np.log(2)
    return logarithms
