"""The derivatives of pictures against PyTorch's autograd of a plain renderer (the extra "torch")."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from tests.devices import KERNELS, open_device
from tests.reference.derivatives import gradient
from tests.reference.raster import render
from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene

torch = pytest.importorskip("torch", reason="the extra torch is not installed")

from tests.oracles.differentiable import Leaves, picture  # noqa: E402 (needs torch)

BACKGROUND = (0.3, 0.6, 0.1)
#: What the kernels are held to: each group of parameters, relative to its derivatives' length.
TOLERANCE = 1e-3


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    return open_device(request.param)


def case(degree, antialiased):
    """Splats with alphas that are capped, colours cut at 0, one behind a camera, x/z beyond the clamp; and views."""
    scene = dataclasses.replace(visible_scene(60, degree, seed=degree), antialiased=antialiased)
    scene.opacity_logits[:6] = 7
    scene.opacity_logits[6] = -9
    scene.sh[:8, 0] -= 3
    cameras = [*ring_of_cameras(4, size=40)[:2], tilted_camera(3, 33, 50)]
    scene.means[9] = 2 * cameras[0].centre
    beside = np.array([2.2, 0.3, 2.5])
    scene.means[10] = cameras[1].rotation.T @ (beside - cameras[1].translation)
    scene.log_scales[10] = 0
    rng = np.random.default_rng(degree)
    return scene, cameras, [rng.normal(size=(c.height, c.width, 3)) for c in cameras]


def autograd(scene, cameras, values, rules, weights):
    """(N, columns) of each kind of parameter: the derivatives of the sum of pictures times values."""
    leaves = Leaves.of(scene)
    loss = 0
    for camera, v, weight in zip(cameras, values, weights, strict=True):
        image = picture(leaves, camera, rules, BACKGROUND, scene.antialiased, scene.low_pass)
        loss = loss + weight * (image * torch.tensor(v)).sum()
    loss.backward()
    return leaves.derivatives()


def errors(found, exact):
    return {k: np.linalg.norm(found[k] - exact[k]) / np.linalg.norm(exact[k]) for k in exact}


CASES = [
    pytest.param(
        degree, antialiased, rules, id=f"degree {degree}, {'antialiased' if antialiased else 'classic'}, {name}"
    )
    for degree, antialiased, name, rules in (
        (0, False, "inria", INRIA),
        (1, True, "inria", INRIA),
        (2, False, "gsplat", GSPLAT),
        (3, False, "inria", INRIA),
        (3, True, "gsplat", GSPLAT),
    )
]


@pytest.mark.parametrize(("degree", "antialiased", "rules"), CASES)
def test_kernels(device, degree, antialiased, rules):
    scene, cameras, values = case(degree, antialiased)
    weights = [REFERENCE_PIXELS / (c.width * c.height) for c in cameras]
    exact = autograd(scene, cameras, values, rules, weights)
    with PictureDerivatives(device, scene, rules, BACKGROUND) as derivatives:
        rows = np.concatenate([each.reshape(-1, 3) for each in values]).astype(np.float32)
        target = device.upload(rows, "the values")
        try:
            derivatives.add(cameras, target, given=True)
            columns = np.split(derivatives.read(), [3, 6, 10, 11], axis=1)
        finally:
            device.free(target)
    found = errors(dict(zip(exact, columns, strict=True)), exact)
    assert max(found.values()) < TOLERANCE, found


@pytest.mark.parametrize(("degree", "antialiased", "rules"), CASES)
def test_the_float64_definition(degree, antialiased, rules):
    """What other tests compare kernels with says the same as autograd; pictures too."""
    scene, cameras, values = case(degree, antialiased)
    exact = autograd(scene, cameras, values, rules, [1.0] * len(cameras))
    sums = {name: 0.0 for name in exact}
    for camera, v in zip(cameras, values, strict=True):
        for name, array in vars(gradient(scene, camera, rules, v, BACKGROUND)).items():
            sums[name] = sums[name] + array.reshape(len(scene), -1)
        image = picture(Leaves.of(scene), camera, rules, BACKGROUND, antialiased).detach().numpy()
        assert np.abs(image - render(scene, camera, rules, BACKGROUND).image).max() < 1e-9
    found = errors(sums, exact)
    assert max(found.values()) < 1e-7, found
