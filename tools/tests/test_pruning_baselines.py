"""The baselines' sums against the float64 definition, and their scores by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tests.devices import FAMILIES, open_device
from tests.reference import raster as reference
from tests.reference.scenes import random_scene, ring_of_cameras
from tools.study import pruning_baselines as baselines
from tools.study.pruning_baselines import mesongs_power, removal_order, scores, transmittance_sums


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    chosen = open_device(request.param)
    device = Device(chosen.info, family=chosen.family, variants=baselines.KERNELS)
    yield device
    assert device.allocated == 0, "not all memory was given back"


def layered_scene(splats: int, seed: int):
    """Large splats, some nearly opaque: many pixels end before the last of them."""
    scene = random_scene(splats, 0, seed)
    rng = np.random.default_rng(seed + 100)
    return dataclasses.replace(
        scene,
        log_scales=rng.normal(-1.7, 0.5, size=(splats, 3)).astype(np.float32),
        opacity_logits=rng.normal(3, 2, size=splats).astype(np.float32),
    )


def sums_by_definition(scene, camera, rules):
    """Σ T and Σ α T of each splat over one view's pixels, and the pixels in which rounding may decide."""
    projected = reference.project(scene, camera, rules)
    shape = (camera.height, camera.width)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    t, alive = np.ones(shape), np.ones(shape, bool)
    plain, weighted = np.zeros(len(scene)), np.zeros(len(scene))
    for k, splat in enumerate(projected.index):
        d = np.stack([x, y], axis=-1) - projected.centre[k]
        power = np.einsum("...i,ij,...j->...", d, np.linalg.inv(projected.covariance[k]), d)
        alpha = np.minimum(projected.opacity[k] * np.exp(-0.5 * power), rules.alpha_cap)
        inside = reference.footprint(projected.centre[k], projected.covariance[k], rules, shape)
        touched = alive & inside & (alpha >= 1 / 255)
        alive &= ~(touched & (t * (1 - alpha) < rules.transmittance_threshold))
        touched &= alive
        plain[splat] = t[touched].sum()
        weighted[splat] = (t * alpha)[touched].sum()
        t = np.where(touched, t * (1 - alpha), t)
    return plain, weighted, int((~alive).sum())


@pytest.mark.parametrize("rules", [INRIA, GSPLAT], ids=["inria", "gsplat"])
def test_transmittance_sums(device, rules):
    scene = layered_scene(150, 3)
    cameras = ring_of_cameras(3, size=50)  # the last tiles are cut
    with Rasterizer(device, scene, rules) as rasterizer:
        found = transmittance_sums(rasterizer, cameras)
        again = transmittance_sums(rasterizer, cameras)
        with RemovalSweep(rasterizer, cameras, SweepOptions(0, 1, transmittance_threshold=None)) as sweep:
            importance = sweep.measure()[1] * sum(c.width * c.height for c in cameras)
    wanted = [sums_by_definition(scene, c, rules) for c in cameras]
    assert sum(w[2] for w in wanted) > 100, "no pixel ends early: the rule is not tested"
    plain = sum(w[0] for w in wanted)
    assert (plain > 0).mean() > 0.9
    # A pixel at one of the thresholds may go either way, with T up to 1.
    assert np.quantile(np.abs(found - plain), 0.95) < 1e-3
    assert np.abs(found - plain).max() < 1.1
    np.testing.assert_allclose(importance, sum(w[1] for w in wanted), atol=0.01)
    assert found.tobytes() == again.tobytes()


def test_a_view_that_sees_nothing(device):
    scene = layered_scene(20, 1)
    scene = dataclasses.replace(scene, means=scene.means + np.float32(100))
    with Rasterizer(device, scene) as rasterizer:
        assert not transmittance_sums(rasterizer, ring_of_cameras(2)[:1]).any()


def test_scores():
    scene = dataclasses.replace(
        random_scene(3),
        log_scales=np.log(np.array([[1, 1, 1], [2, 2, 2], [4, 1, 0.5]], np.float32)),
        opacity_logits=np.array([0, np.log(3), -np.log(3)], np.float32),
    )
    importance, transmittance = np.array([3.0, 1.0, 2.0]), np.array([4.0, 8.0, 8.0])
    volume = np.array([1.0, 8.0, 2.0])
    opacity = np.array([0.5, 0.75, 0.25])
    found = scores(scene, importance, transmittance, mesongs_power=0.5, seed=7)

    def same_up_to_a_factor(score, wanted):
        np.testing.assert_allclose(score / score[0], wanted / wanted[0], rtol=1e-5)

    same_up_to_a_factor(found["LightGaussian"], opacity * transmittance * volume**0.1)
    same_up_to_a_factor(found["MesonGS"], importance * volume**0.5)
    same_up_to_a_factor(found["importance"], importance)
    same_up_to_a_factor(found["opacity"], opacity)
    assert sorted(found["random"]) == [0, 1, 2]
    repeated = scores(scene, importance, transmittance, mesongs_power=0.5, seed=7)
    assert (repeated["random"] == found["random"]).all()


def test_removal_order():
    assert removal_order(np.array([2.0, 1.0, 2.0, 0.0])).tolist() == [3, 1, 0, 2]


def test_mesongs_power():
    assert mesongs_power("lego") == 0.05
    assert mesongs_power("unknown") == 0.1
