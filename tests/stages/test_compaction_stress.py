"""Compaction of systems at their worst: ill-conditioned, of extreme weights, far away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor
from tests.cases.ridges import (
    channels,
    check_optimal,
    dense_weights,
    on_a_sphere,
    sparse_weights,
)
from tests.reference.ridge import (
    weighted_basis,
)
from tests.reference.scenes import random_scene


def clustered(views: int, spread: float, seed: int) -> NDArray[np.float64]:
    """Views within an angle of about ``spread`` of each other: the condition number grows with its third power."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    directions = axis / np.linalg.norm(axis) + spread * rng.normal(size=(views, 3))
    return 6 * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def bounded(scene: Scene, compacted: Scene) -> bool:
    """The bounds that compaction promises."""
    before, after = channels(scene.sh), channels(compacted.sh)
    limit = 4 * np.maximum(np.linalg.norm(before, axis=1), 1)
    ac = np.linalg.norm(before[:, 1:], axis=1) + np.linalg.norm(after[:, 1:], axis=1)
    return bool(
        np.isfinite(after).all()
        and (np.abs(after[:, 1:]).max(axis=1) <= limit * (1 + 1e-6)).all()
        # DC is a weighted mean of colours less those of the AC terms, whose basis is at most 3.88 times DC's.
        and (np.abs(after[:, 0] - before[:, 0]) <= 3.88 * ac + 1e-4 * limit).all()
    )


@pytest.mark.parametrize("spread", [1.0, 1e-2, 1e-5, 0.0])
def test_ill_conditioned_systems(compacting: Device, spread: float) -> None:
    for alpha in [0.9, 1.0]:
        for lam in [0.0, 1e-6, 1.0, 1e12]:
            scene = random_scene(12, seed=9)
            scene = replace(scene, means=np.zeros_like(scene.means))
            centres = clustered(40, spread, seed=9)
            rng = np.random.default_rng(9)
            # From all weights alike to 18 decades among them: condition numbers from 1 to far beyond 1e14.
            dense = 10 ** rng.uniform(-1, 1, (12, 40)) ** np.repeat([0, 1, 3], 4)[:, None]
            dense[8:] = 10 ** rng.uniform(-12, 6, (4, 40))
            dense = dense.astype(np.float32)
            options = CompactionOptions(lam=lam, alpha=alpha)
            compacted = Compactor(compacting).compact(scene, centres, dense_weights(dense), options)
            assert bounded(scene, compacted)
            check_optimal(scene, compacted, centres, dense, options)


def test_the_stress_reaches_condition_numbers_of_1e14() -> None:
    centres = clustered(40, 1e-2, seed=9)
    basis = weighted_basis(np.zeros(3), centres, np.ones(40), 3)
    assert np.linalg.cond(basis / np.linalg.norm(basis, axis=0)) > 1e7  # of the Gram matrix: the square


@pytest.mark.parametrize("views", ["one", "opposite", "same place", "ring"])
def test_extreme_weights(compacting: Device, views: str) -> None:
    for lam in [0.0, 1.0, 1e12]:
        for weight in [1e-12, 1.0, 1e6]:
            centres = {
                "one": on_a_sphere(1),
                "opposite": np.array([[0.0, 6, 0], [0, -6, 0]]),
                "same place": np.tile(on_a_sphere(1), (7, 1)),
                "ring": np.stack([6 * np.cos(np.arange(9)), 6 * np.sin(np.arange(9)), np.zeros(9)], axis=1),
            }[views]
            scene = random_scene(6, seed=10)
            scene = replace(scene, means=(0.01 * scene.means * (np.arange(6) > 2)[:, None]).astype(np.float32))
            dense = np.full((6, len(centres)), weight, np.float32)
            for alpha in (0.7, 1.0):
                options = CompactionOptions(lam=lam, alpha=alpha)
                compacted = Compactor(compacting).compact(scene, centres, dense_weights(dense), options)
                assert bounded(scene, compacted)
                check_optimal(scene, compacted, centres, dense, options)


def test_a_splat_in_a_camera_stays_finite(compacting: Device) -> None:
    scene = random_scene(4, seed=11)
    centres = np.concatenate([scene.means.astype(np.float64), on_a_sphere(3)])
    assert bounded(scene, Compactor(compacting).compact(scene, centres, dense_weights(np.ones((4, 7)))))


def test_far_from_the_origin(compacting: Device) -> None:
    """Directions come from differences of positions with all their digits."""
    scene = random_scene(20, seed=12)
    offset = np.array([3e5, -2e5, 1e5])
    far = replace(scene, means=(scene.means + offset).astype(np.float32))
    near = replace(scene, means=(far.means.astype(np.float64) - offset).astype(np.float32))
    centres = on_a_sphere(30)
    weights = dense_weights(sparse_weights(20, 30, seed=12))
    options = CompactionOptions(lam=0.1, two_pass=False)
    results = [
        Compactor(compacting).compact(s, c, weights, options).sh for s, c in ((near, centres), (far, centres + offset))
    ]
    np.testing.assert_allclose(*results, atol=1e-4)


def test_a_solution_that_grows_too_much_is_refused(compacting: Device) -> None:
    """Views on a short arc: many columns are parallel to y's, which would have to stand in for all of them."""
    angle = 1e-3 * np.arange(-5, 6)
    centres = -6 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    basis = weighted_basis(np.zeros(3), centres, np.ones(11), 3)
    in_terms_of_y = basis.T @ basis[:, 1] / (basis[:, 1] @ basis[:, 1])
    parallel = np.abs(in_terms_of_y) * np.linalg.norm(basis[:, 1]) > 0.9 * np.linalg.norm(basis, axis=0)
    assert np.abs(in_terms_of_y[parallel]).max() > 3
    scene = random_scene(2, seed=13)
    sh = np.zeros((2, 16, 3), np.float32)
    sh[:, parallel] = np.where(np.arange(2) == 0, 40, 0.01)[:, None, None] * in_terms_of_y[parallel, None]
    scene = replace(scene, sh=sh, means=np.zeros((2, 3), np.float32))
    options = CompactionOptions(lam=0, two_pass=False, colour_model="rgb")
    compacted = Compactor(compacting).compact(scene, centres, dense_weights(np.ones((2, 11))), options)
    np.testing.assert_array_equal(compacted.sh[0], scene.sh[0])
    assert np.count_nonzero(compacted.sh[1, :, 0]) <= 3


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**32 - 1),
    views=st.integers(1, 30),
    log_lam=st.floats(-8, 12),
    alpha=st.floats(0.3, 1),
    decades=st.floats(0, 9),
    spread=st.floats(0, 1),
    degree=st.integers(1, 3),
)
@settings(max_examples=20)
def test_any_system_is_bounded_and_optimal(
    seed: int, views: int, log_lam: float, alpha: float, decades: float, spread: float, degree: int
) -> None:
    scene = random_scene(6, degree, seed)
    centres = clustered(views, spread, seed)
    dense = (10 ** np.random.default_rng(seed).uniform(-decades, decades / 3, (6, views))).astype(np.float32)
    options = CompactionOptions(lam=10**log_lam, alpha=alpha)
    compacted = Compactor(Device(family="cpu")).compact(scene, centres, dense_weights(dense), options)
    assert bounded(scene, compacted)
    check_optimal(scene, compacted, centres, dense, options)
