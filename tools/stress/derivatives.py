"""The derivatives that the fit uses, at their worst (:func:`check_derivatives`): a part of tools.stress.run.

Jᵀ v is judged against float64 in pixels that are clear of all thresholds, the others have v = 0. And no case whatever
may leave a number that is not finite.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.rules import RasterRules
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from tests.reference.derivatives import gradient
from tools.stress.precise import F64, ULP

#: Colours, and conditions of covariances, beyond which only finiteness is asked for: brighter ones are cut by design,
#: and float64 itself loses the inverse of thinner ones.
_BRIGHTEST, _CONDITION = 4.0, 1e7
#: Kinds of parameters end at these columns.
_ENDS = (3, 6, 10, 11)
#: Derivatives of a kind are compared with their own length, or with this part of the longest kind's.
_LEAST = 1e-3


def check_derivatives(
    device: Device,
    scene: Scene,
    view: Camera,
    rules: RasterRules,
    clear: NDArray[np.bool_] | None,
    sound: bool,
    stand_in: Callable[[np.random.Generator | None], tuple[Scene, Camera]],
    draws: int,
) -> dict[str, tuple[float, float]]:
    """The measures "fit: finite" and "fit: gradient" of a view.

    Args:
        device: to test.
        scene, view, rules: the case.
        clear: (pixels,) which of them are clear of thresholds; None: not known.
        sound: whether float64 can tell the derivatives.
        stand_in: the scene and the view in float64, or what rounding may make of them.
        draws: of such roundings.
    """
    rng = np.random.default_rng(0)
    shape = (view.height, view.width, 3)
    values = rng.normal(size=shape).astype(np.float32)
    if clear is not None:
        values *= clear.reshape(*shape[:2], 1)
    with PictureDerivatives(device, scene, rules) as derivatives, Memory(device) as memory:
        found = _transposed(derivatives, memory, view, values)
        finite = np.isfinite(found).all()
        measures = {"fit: finite": (0.0 if finite else np.inf, ULP)}
    if not finite or clear is None or not sound:
        return measures
    exact = _exact(*stand_in(None), rules, values)
    if exact is None:
        return measures
    lengths = np.array([np.linalg.norm(part) for part in exact])
    scales = np.maximum(lengths, _LEAST * lengths.max())
    if not lengths.max() > 0:
        return measures
    parts = np.split(found.astype(np.float64) * view.width * view.height / REFERENCE_PIXELS, _ENDS, axis=1)
    error, expected = _difference(parts, exact, scales), 16 * ULP
    for _ in range(draws):
        moved = _exact(*stand_in(rng), rules, values)
        if moved is not None:
            expected = max(expected, _difference(moved, exact, scales))
    measures["fit: gradient"] = (error, expected)
    return measures


def tellable(covariances: F64, colours: F64) -> bool:
    """Whether float64 can tell the derivatives of these splats: (K, 2, 2) on screen, (K, 3) R, G, B."""
    if not (np.isfinite(covariances).all() and np.isfinite(colours).all()):
        return False
    if not len(covariances) or np.abs(covariances).max() > 1e12 or colours.max() > _BRIGHTEST:
        return False
    return bool(np.linalg.cond(covariances).max() < _CONDITION)


def _transposed(derivatives: PictureDerivatives, memory: Memory, view: Camera, values: NDArray[np.float32]) -> F64:
    """(N, columns) Jᵀ W v."""
    target = memory.upload(values.reshape(-1, 3), "the values")
    derivatives.forget()
    derivatives.add([view], target, given=True)
    return derivatives.read().astype(np.float64)


def _exact(scene: Scene, view: Camera, rules: RasterRules, values: NDArray[np.float32]) -> list[F64] | None:
    """Jᵀ v by kind of parameter in float64; None where float64 cannot tell it either."""
    with np.errstate(all="ignore"):
        try:
            found = gradient(scene, view, rules, values.astype(np.float64))
        except np.linalg.LinAlgError:
            return None
    parts = [array.reshape(len(array), -1) for array in vars(found).values()]
    return parts if all(np.isfinite(part).all() for part in parts) else None


def _difference(parts: list[F64], exact: list[F64], scales: F64) -> float:
    """The largest of the kinds' relative errors."""
    return max(float(np.linalg.norm(a - b) / s) for a, b, s in zip(parts, exact, scales, strict=True))
