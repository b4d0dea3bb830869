"""The fit and its derivatives at their worst: a part of tools.stress.run.

The fit's steps, with the choice of coefficients and the roundings after them, may leave nothing that is not finite, and
no worse scene. (The tests hold that other roads to the same result give the same bits.) Jᵀ v is judged against float64
in pixels that are clear of all thresholds, the others have v = 0; and no case whatever may leave a number that is not
finite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import RasterRules
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.stages.fitting.fit import FitOptions, Sight, fit_scene
from potr_cl.stages.fitting.settling import Settling, settle
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.targets import RenderedTargets
from tests.reference.derivatives import gradient
from tools.stress.cases import Case
from tools.stress.measures import Measures
from tools.stress.precise import DRAWS, F64, ULP, Pixels, alphas_of_covariances, projected, stand_in

#: Steps of the fit that are tried, and what a held-out view may lose: nothing.
_STEPS = FitOptions(steps=6, rounds=2, batch=1)
_PARAMETERS = HyperParameters.from_quality(0.3, "best")


def check_fits(device: Device, case: Case) -> Measures:
    """The measures "fit: steps" and "fit: settling" of a view."""
    scene, view = case.scene, case.view
    return {"fit: steps": (_fitted(device, scene, view), 1e-9), "fit: settling": (_settled(device, scene, view), 1.0)}


def _shaken(scene: Scene) -> Scene:
    """The scene with errors that a fit could mend; what is not finite after it is left."""
    rng = np.random.default_rng(0)
    with np.errstate(over="ignore"):
        means = (scene.means * (1 + 1e-3 * rng.normal(size=scene.means.shape))).astype(np.float32)
        sh = (scene.sh * (1 + 0.05 * rng.normal(size=scene.sh.shape))).astype(np.float32)
    return dataclasses.replace(
        scene, means=np.where(np.isfinite(means), means, scene.means), sh=np.where(np.isfinite(sh), sh, scene.sh)
    )


def _fitted(device: Device, scene: Scene, view: Camera) -> float:
    """How much worse the scene that a fit keeps is than the one it was given; infinite if it is not finite.

    Squares of colours beyond 1e19 have no number in single precision: then the given scene is kept.
    """
    views = [view, dataclasses.replace(view, name="the same again")]  # to fit to, and to judge by
    with Rasterizer(device, scene) as rasterizer:
        fitted = fit_scene(device, _shaken(scene), Sight(views, RenderedTargets(rasterizer, views)), _STEPS)
    if not is_finite(fitted.scene):
        return np.inf
    if not np.isfinite(fitted.errors[0]):
        return 0.0 if fitted.kept == 0 else np.inf
    return max(fitted.error / max(fitted.errors[0], 1e-20) - 1, 0.0)


def _settled(device: Device, scene: Scene, view: Camera) -> float:
    """1 for a value that is not finite after coefficients are chosen and geometry is rounded, with fits in between."""
    views = [view, dataclasses.replace(view, name="the same again")]  # to fit to, and to judge by
    bench = Workbench(_PARAMETERS, device=device)
    settling = Settling(choosing=0.5, rounding=0.5, gentle=1.0, through=1.0)
    with Rasterizer(device, scene) as rasterizer:
        sight = Sight(views, RenderedTargets(rasterizer, views))

        def pictures(some: Sequence[Camera]) -> AbstractContextManager[RenderedTargets]:
            return nullcontext(RenderedTargets(rasterizer, some))

        try:
            state, _ = settle(State.of(scene, views), bench, sight, pictures, settling, _STEPS)
        except DataError:  # no file holds such a scene, and the encode says so
            return 0.0
    finite = is_finite(state.scene)
    if state.geometry is not None:
        finite &= is_finite(state.geometry.decoded(state.scene.sh))
    return 0.0 if finite else 1.0


def is_finite(scene: Scene) -> bool:
    """Whether all parameters of a scene are."""
    return all(bool(np.isfinite(each).all()) for each in scene.arrays)


#: Colours, and conditions of covariances, beyond which only finiteness is asked for: brighter ones are cut by design,
#: and float64 itself loses the inverse of thinner ones.
_BRIGHTEST, _CONDITION = 4.0, 1e7
#: Kinds of parameters end at these columns.
_ENDS = (3, 6, 10, 11)
#: Derivatives of a kind are compared with their own length, or with this part of the longest kind's.
_LEAST = 1e-3


def check_derivatives(device: Device, case: Case, clear: NDArray[np.bool_] | None) -> Measures:
    """The measures "fit: finite" and "fit: gradient" of a view.

    Args:
        clear: (pixels,) which of them are clear of thresholds; None: not known.
    """
    rng, view = np.random.default_rng(0), case.view
    values = rng.normal(size=(view.height * view.width, 3)).astype(np.float32)
    if clear is not None:
        values *= clear[:, None]
    with PictureDerivatives(device, case.scene, case.rules) as derivatives, Memory(device) as memory:
        derivatives.forget()
        derivatives.add([view], memory.upload(values, "the values"), given=True)
        found = derivatives.read().astype(np.float64)
    finite = np.isfinite(found).all()
    measures: Measures = {"fit: finite": (0.0 if finite else np.inf, ULP)}
    if not finite or clear is None or not _tellable(case):
        return measures
    exact = _exact(*stand_in(case), case.rules, values)
    lengths = np.array([np.linalg.norm(part) for part in exact or ()])
    if exact is None or not lengths.max() > 0:
        return measures
    scales = np.maximum(lengths, _LEAST * lengths.max())
    parts = np.split(found * view.width * view.height / REFERENCE_PIXELS, _ENDS, axis=1)
    error, expected = _difference(parts, exact, scales), 16 * ULP
    for _ in range(DRAWS):
        moved = _exact(*stand_in(case, rng), case.rules, values)
        if moved is not None:
            expected = max(expected, _difference(moved, exact, scales))
    return measures | {"fit: gradient": (error, expected)}


def _tellable(case: Case) -> bool:
    """Whether float64 can tell the derivatives of the splats that are seen."""
    true = projected(case)
    shown = (alphas_of_covariances(true, Pixels.of(case.view)) >= 1 / 255).any(axis=1)
    covariances, colours = true.covariance[shown], true.colour[shown]
    if not (len(colours) and np.isfinite(covariances).all() and np.isfinite(colours).all()):
        return False
    if np.abs(covariances).max() > 1e12 or colours.max() > _BRIGHTEST:
        return False
    return bool(np.linalg.cond(covariances).max() < _CONDITION)


def _exact(scene: Scene, view: Camera, rules: RasterRules, values: NDArray[np.float32]) -> list[F64] | None:
    """Jᵀ v by kind of parameter in float64; None where float64 cannot tell it either."""
    with np.errstate(all="ignore"):
        try:
            found = gradient(scene, view, rules, values.reshape(view.height, view.width, 3).astype(np.float64))
        except np.linalg.LinAlgError:
            return None
    parts = [array.reshape(len(array), -1) for array in vars(found).values()]
    return parts if all(np.isfinite(part).all() for part in parts) else None


def _difference(parts: list[F64], exact: list[F64], scales: F64) -> float:
    """The largest of the kinds' relative errors."""
    return max(float(np.linalg.norm(a - b) / s) for a, b, s in zip(parts, exact, scales, strict=True))
