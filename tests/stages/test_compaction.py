"""SH energy compaction against its float64 definition, its invariants, and systems at their worst."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from potr_cl.errors import DeviceError, UsageError
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor
from potr_cl.stages.compaction.view_weights import ViewWeights
from tests.cases.ridges import channels, check_optimal, dense_weights, on_a_sphere, sparse_weights
from tests.devices import shared_device
from tests.reference.ridge import (
    Ridges,
    compact_channel,
    objective,
    ridge,
    triangles,
    usable_columns,
    usable_columns_of,
    weighted_basis,
)
from tests.reference.scenes import random_scene


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"alpha": 1.0},
        {"two_pass": False},
        {"colour_model": "rgb"},
        {"weighting": "visibility"},
        {"lam": 1e-4, "chroma_factor": 10.0},
        {"lam": 100.0, "alpha": 0.7, "sf_sh": 101.0},
    ],
)
def test_the_definition(compacting: Device, changes: dict[str, object]) -> None:
    for degree in [1, 2, 3]:
        options = replace(CompactionOptions(), **changes)  # type: ignore[arg-type]
        scene = random_scene(12, degree, seed=degree)
        centres = on_a_sphere(30)
        dense = sparse_weights(len(scene), 30)
        compacted = Compactor(compacting).compact(scene, centres, dense_weights(dense), options)
        if options.weighting == "visibility":
            dense = (dense > 0).astype(np.float32)
        check_optimal(scene, compacted, centres, dense, options)

        ycocg = options.colour_model == "ycocg"
        before, after = channels(scene.sh, ycocg), channels(compacted.sh, ycocg)
        differing = 0
        for k in np.flatnonzero((dense > 0).any(axis=1)):
            basis = weighted_basis(scene.means[k].astype(np.float64), centres, dense[k].astype(np.float64), degree)
            for c in range(3):
                lam = options.lam * (options.chroma_factor if ycocg and c else 1)
                x, used = compact_channel(basis, before[k, :, c], lam, options.alpha, options.sf_sh, options.two_pass)
                free = np.abs(after[k, :, c]) > 1e-6
                free[0] = used[0] = True
                differing += not np.array_equal(free, used & (np.abs(x) > 1e-6))
        assert differing <= 2  # a cosine or a coefficient within rounding of its threshold


@pytest.mark.one_runtime
def test_what_there_is_nothing_to_do_for_is_left_as_it_is(compacting: Device) -> None:
    """All but SH, degree 0, and an empty scene."""
    scene, centres = random_scene(20), on_a_sphere(10)
    compacted = Compactor(compacting).compact(scene, centres, dense_weights(sparse_weights(20, 10)))
    for name in ("means", "log_scales", "quaternions", "opacity_logits"):
        assert getattr(compacted, name) is getattr(scene, name)
    assert compacted.sh.shape == scene.sh.shape
    assert compacted.sh.dtype == np.float32
    plain = random_scene(5, degree=0)
    assert Compactor(compacting).compact(plain, centres, dense_weights(sparse_weights(5, 10))) is plain
    nothing = scene.subset(np.zeros(20, bool))
    assert len(Compactor(compacting).compact(nothing, centres, dense_weights(np.zeros((0, 10))))) == 0


def test_unseen_splats_keep_dc_and_lose_ac(compacting: Device) -> None:
    scene = random_scene(9)
    dense = sparse_weights(9, 10, seed=1) + np.float32(1e-3)
    dense[[0, 4, 8]] = 0
    compacted = Compactor(compacting).compact(scene, on_a_sphere(10), dense_weights(dense))
    np.testing.assert_array_equal(compacted.sh[[0, 4, 8], 0], scene.sh[[0, 4, 8], 0])
    assert not compacted.sh[[0, 4, 8], 1:].any()
    nobody = Compactor(compacting).compact(scene, on_a_sphere(10), dense_weights(0 * dense))
    np.testing.assert_array_equal(nobody.sh[:, 0], scene.sh[:, 0])
    assert not nobody.sh[:, 1:].any()


def test_batches_repetition_and_strides_change_no_byte(compacting: Device) -> None:
    scene = random_scene(150, seed=3)
    strided = replace(scene, sh=np.asfortranarray(scene.sh))
    centres, weights = on_a_sphere(20), dense_weights(sparse_weights(150, 20, seed=3))
    whole = Compactor(compacting).compact(scene, centres, weights)
    for memory, same in ((None, scene), (None, strided), (20_000, scene), (1, scene)):
        again = Compactor(compacting, memory).compact(same, centres, weights)
        assert again.sh.tobytes() == whole.sh.tobytes()


@pytest.mark.one_runtime
def test_memory_that_runs_out_half_way_is_given_back(compacting: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = 0

    def allocate(nbytes: int, what: str) -> object:
        nonlocal taken
        taken += 1
        if taken == 9:  # within the second batch's buffers
            raise DeviceError("full")
        return Device.allocate(compacting, nbytes, what)

    monkeypatch.setattr(compacting, "allocate", allocate)
    with pytest.raises(DeviceError, match="full"):
        Compactor(compacting, 1).compact(random_scene(9), on_a_sphere(4), dense_weights(np.ones((9, 4))))
    assert compacting.allocated == 0


@pytest.mark.parametrize("degree", [1, 3])
def test_the_definition_of_many_splats_is_that_of_one(degree: int) -> None:
    scene = random_scene(40, degree, seed=21)
    centres, dense = on_a_sphere(30), sparse_weights(40, 30, seed=21)
    channel = np.random.default_rng(21).normal(size=(40, (degree + 1) ** 2))
    known = 0
    for splats, triangle in triangles(scene.means.astype(np.float64), centres, dense_weights(dense), degree, 7):
        used = usable_columns_of(triangle, 0.9)
        ridges = Ridges(triangle, channel[splats], used, 0.3)
        solved = ridges.solution()
        excess, optimum = ridges.excess(channel[splats])
        for i, k in enumerate(splats):
            basis = weighted_basis(scene.means[k].astype(np.float64), centres, dense[k].astype(np.float64), degree)
            np.testing.assert_array_equal(used[i], usable_columns(basis, 0.9))
            x = ridge(basis, channel[k], used[i], 0.3)
            np.testing.assert_allclose(solved[i], x, rtol=1e-6, atol=1e-9)
            best = objective(basis, channel[k], x, 0.3)
            assert optimum[i] == pytest.approx(best, rel=1e-9)
            ours = np.where(used[i], channel[k], 0)
            assert excess[i] == pytest.approx(objective(basis, channel[k], ours, 0.3) - best, rel=1e-6)
            known += 1
    assert known == np.count_nonzero((dense > 0).any(axis=1))


@pytest.mark.parametrize("precision", ["orthogonal", "cholesky"])
def test_variants_solve_easy_systems(compacting: Device, precision: str) -> None:
    scene = random_scene(20, seed=14)
    centres, dense = on_a_sphere(60), np.ones((20, 60), np.float32)
    options = replace(CompactionOptions(), precision=precision)  # type: ignore[arg-type]
    compacted = Compactor(compacting).compact(scene, centres, dense_weights(dense), options)
    check_optimal(scene, compacted, centres, dense, options)


@pytest.mark.one_runtime
def test_views_that_do_not_belong_to_the_scene(compacting: Device) -> None:
    scene, weights = random_scene(5), dense_weights(np.ones((5, 4)))
    compactor = Compactor(compacting)
    with pytest.raises(UsageError, match="of 5 splats, the scene has 3"):
        compactor.compact(random_scene(3), on_a_sphere(4), weights)
    with pytest.raises(UsageError, match="outside the 3 given"):
        compactor.compact(scene, on_a_sphere(3), weights)
    with pytest.raises(UsageError, match="not finite positions"):
        compactor.compact(scene, np.full((4, 3), np.nan), weights)
    with pytest.raises(UsageError, match="outside the 2 given"):
        compactor.compact(scene, on_a_sphere(8).reshape(2, 4, 3), weights)


@pytest.mark.parametrize(
    ("offsets", "weights", "message"),
    [
        ([1, 2], [1, 1], "start at 0"),
        ([0, 2, 1], [1], "never fall"),
        ([0, 3], [1, 1], "offsets end at 3"),
        ([0, 2], [1, -1], "negative"),
        ([0, 2], [1, np.nan], "not a number"),
        ([0, 1], [1e30], "above 1e"),
    ],
)
def test_weights_that_are_none(offsets: list[int], weights: list[float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ViewWeights(np.array(offsets), np.zeros(len(weights), np.int32), np.array(weights, np.float32))


# -------------------------------------------------------------------------------- systems at their worst


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
                if views == "one":  # DC alone reproduces one colour exactly, whatever lambda
                    assert np.abs(compacted.sh[:, 1:]).max() < 1e-6


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
    compacted = Compactor(shared_device("cpu")).compact(scene, centres, dense_weights(dense), options)
    assert bounded(scene, compacted)
    check_optimal(scene, compacted, centres, dense, options)
