"""The float64 derivatives of pictures against finite differences of the float64 pictures."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from potr_cl.raster.rules import GSPLAT, INRIA
from tests.reference.derivatives import gradient
from tests.reference.raster import render
from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


class Precise(SimpleNamespace):
    """A scene with arrays in float64, and quaternions of length 1."""

    def __init__(self, scene):
        super().__init__(**{name: getattr(scene, name).astype(np.float64) for name in PARAMETERS})
        self.quaternions /= np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        self.sh_degree, self.antialiased, self.low_pass = scene.sh_degree, scene.antialiased, scene.low_pass

    def __len__(self):
        return len(self.means)

    def moved(self, direction, step):
        other = Precise(self)
        for name in PARAMETERS:
            setattr(other, name, getattr(self, name) + step * direction[name])
        return other


@pytest.mark.parametrize(
    ("rules", "antialiased", "camera"),
    [
        pytest.param(INRIA, False, ring_of_cameras(3, size=40)[1], id="inria-level"),
        pytest.param(INRIA, True, tilted_camera(3, 40, 30), id="inria-antialiased-tilted"),
        pytest.param(GSPLAT, False, tilted_camera(3, 40, 30), id="gsplat-tilted"),
    ],
)
def test_gradient_is_that_of_finite_differences(rules, antialiased, camera):
    """Of a random combination of the pixels along some random directions in each kind of parameters."""
    scene = visible_scene(25, 3, seed=1)
    scene.opacity_logits[:5] = 6  # capped
    scene.sh[:4, 0] -= 3  # cut at 0
    precise = Precise(dataclasses.replace(scene, antialiased=antialiased))
    rng = np.random.default_rng(5)
    values = rng.normal(size=(camera.height, camera.width, 3))
    background = (0.3, 0.6, 0.1)
    gradients = gradient(precise, camera, rules, values, background)
    step = 1e-7
    for parameter in [name for name in PARAMETERS for _ in range(2)]:
        found, direction = getattr(gradients, parameter), {name: np.zeros(1) for name in PARAMETERS}
        assert np.abs(found).max() > 0
        direction[parameter] = rng.normal(size=found.shape)
        ahead, back = (render(precise.moved(direction, s), camera, rules, background).image for s in (step, -step))
        wanted = float(((ahead - back) / (2 * step) * values).sum())
        size = np.linalg.norm(found) * np.linalg.norm(direction[parameter])
        assert abs((found * direction[parameter]).sum() - wanted) < 1e-6 * size, parameter


def test_a_splat_that_is_not_drawn_has_no_gradient():
    scene = visible_scene(6, 1)
    camera = ring_of_cameras(1)[0]
    scene.means[0] = 2 * camera.centre  # behind the camera
    scene.opacity_logits[1] = -9
    found = gradient(scene, camera, INRIA, np.ones((camera.height, camera.width, 3)))
    for name in PARAMETERS:
        assert not getattr(found, name)[:2].any()
        assert np.isfinite(getattr(found, name)).all()
