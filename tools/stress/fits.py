"""Fits at their worst (:func:`check_fits`): a part of tools.stress.run.

The fit's steps, with the choice of coefficients and the roundings after them, may leave nothing that is not finite, and
no worse scene. (The tests hold that other roads to the same result give the same bits.)
"""

from __future__ import annotations

import dataclasses

import numpy as np

from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting.fit import FitOptions, fit_scene
from potr_cl.stages.fitting.settling import Looking, Settling, settle
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.targets import RenderedTargets
from tools.stress.cases import Case
from tools.stress.measures import Measures

#: Steps of the fit that are tried, and what a held-out view may lose: nothing.
_STEPS = FitOptions(steps=6, rounds=2, batch=1)
_PARAMETERS = HyperParameters.from_quality(0.3, "best")


def check_fits(device: Device, case: Case) -> Measures:
    """The measures "fit: steps" and "fit: settling" of a view."""
    scene, view = case.scene, case.view
    return {"fit: steps": (_fitted(device, scene, view), 1e-9), "fit: settling": (_settled(device, scene, view), 1.0)}


def _looked_at(view: Camera) -> list[Camera]:
    """A view to fit to, and the same to judge by."""
    return [view, dataclasses.replace(view, name="the same again")]


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
    views = _looked_at(view)
    with Rasterizer(device, scene) as rasterizer:
        fitted = fit_scene(device, _shaken(scene), views, RenderedTargets(rasterizer, views), _STEPS)
    if not is_finite(fitted.scene):
        return np.inf
    if not np.isfinite(fitted.errors[0]):
        return 0.0 if fitted.kept == 0 else np.inf
    return max(fitted.error / max(fitted.errors[0], 1e-20) - 1, 0.0)


def _settled(device: Device, scene: Scene, view: Camera) -> float:
    """1 for a value that is not finite after coefficients are chosen and geometry is rounded, with fits in between."""
    views = _looked_at(view)
    bench = Workbench(_PARAMETERS, device=device)
    settling = Settling(choosing=0.5, rounding=0.5, gentle=1.0, through=1.0)
    with Rasterizer(device, scene) as rasterizer:
        looking = Looking(views, 0, RenderedTargets(rasterizer, views), rasterizer)
        try:
            state, _ = settle(State.of(scene, views), bench, looking, settling, _STEPS)
        except DataError:  # no file holds such a scene, and the encode says so
            return 0.0
    finite = is_finite(state.scene)
    if state.geometry is not None:
        finite &= is_finite(state.geometry.decoded(state.scene.sh))
    return 0.0 if finite else 1.0


def is_finite(scene: Scene) -> bool:
    """Whether all parameters of a scene are."""
    arrays = (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh)
    return all(bool(np.isfinite(each).all()) for each in arrays)
