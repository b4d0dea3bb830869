"""What the compaction weighs views with, and what comes of it on a real scene."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from potr_cl.codec.quantize import quantize_sh, to_ycocg
from potr_cl.model.camera import Camera, camera_centres, resized, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor, Weighting
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS, ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from tests.cases.ridges import check_optimal, dense_weights, on_a_sphere
from tests.reference.scenes import random_scene


def measured_weights(device: Device, scene: Scene, cameras: list[Camera]) -> ViewWeights:
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras) as sweep:
        sweep.measure()
        return ViewWeights.from_importances(len(scene), sweep.view_importances())


def zeros(sh: NDArray[np.floating]) -> float:
    """Share of AC coefficients that the quantiser rounds to zero."""
    steps = [quantize_sh(c, 51.0) for m in range(1, sh.shape[1]) for c in to_ycocg(sh[:, m].astype(np.float64))]
    return float(np.mean(np.concatenate(steps) == 0))


def test_real_systems(device: Device, plush_excerpt: Scene, plush_excerpt_cameras: list[Camera]) -> None:
    views = train_views(plush_excerpt_cameras)
    centres = camera_centres(views)
    weights = measured_weights(device, plush_excerpt, views)
    dense = np.zeros((len(plush_excerpt), len(views)), np.float32)
    dense[np.repeat(np.arange(len(plush_excerpt)), np.diff(weights.offsets)), weights.views] = weights.weights
    some = np.arange(0, len(plush_excerpt), 7)
    for alpha in (0.9, 1.0):
        options = CompactionOptions(lam=0.1, alpha=alpha)
        compacted = Compactor(device).compact(plush_excerpt, centres, weights, options)
        check_optimal(plush_excerpt.subset(some), compacted.subset(some), centres, dense[some], options)
        assert zeros(compacted.sh) > zeros(plush_excerpt.sh) + 0.15


def test_half_the_resolution_gives_the_same_sparsity(
    usual_device: Device, plush_excerpt: Scene, plush_excerpt_cameras: list[Camera]
) -> None:
    """From 480 x 360 to 240 x 180; the rasterizer's dilation by 0.3 pixels hardly matters yet."""
    views = train_views(plush_excerpt_cameras)
    sparsity = []
    for factor in (2, 1):
        larger = [resized(view, factor * view.width, factor * view.height) for view in views]
        weights = measured_weights(usual_device, plush_excerpt, larger)
        compacted = Compactor(usual_device).compact(plush_excerpt, camera_centres(views), weights)
        sparsity.append(zeros(compacted.sh))
    assert sparsity[1] == pytest.approx(sparsity[0], abs=0.01)


def test_weights_from_importances() -> None:
    rng = np.random.default_rng(15)
    dense = rng.random((50, 7)) * (rng.random((50, 7)) < 0.4)
    per_view = ((s, np.flatnonzero(dense[:, s]), dense[dense[:, s] > 0, s]) for s in range(7))
    weights = ViewWeights.from_importances(50, per_view)
    expected = dense_weights(dense)
    np.testing.assert_array_equal(weights.offsets, expected.offsets)
    np.testing.assert_array_equal(weights.views, expected.views)
    np.testing.assert_allclose(weights.weights, REFERENCE_PIXELS * expected.weights, rtol=1e-6)


@pytest.mark.parametrize("weighting", ["importance", "visibility"])
def test_a_view_that_stands_for_several_positions(device: Device, weighting: Weighting) -> None:
    rng = np.random.default_rng(16)
    scene, centres = random_scene(40, seed=7), on_a_sphere(24)
    dense = rng.random((40, 8)) * (rng.random((40, 8)) < 0.6)
    apart = dense_weights(np.repeat(dense / 3, 3, axis=1))
    if weighting == "visibility":
        apart = dense_weights(np.repeat((dense > 0) / 3, 3, axis=1))
    options = CompactionOptions(weighting=weighting)
    shared = Compactor(device, 6000).compact(scene, centres.reshape(8, 3, 3), dense_weights(dense), options)
    expected = Compactor(device).compact(scene, centres, apart, CompactionOptions())
    np.testing.assert_allclose(shared.sh, expected.sh, atol=2e-5)
