"""SH energy compaction against its float64 definition, its invariants, and under stress."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from potr_cl.codec.quantize import quantize_sh, to_ycocg
from potr_cl.errors import DeviceError, UsageError
from potr_cl.model.camera import Camera, camera_centres, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.reference.ridge import (
    YCOCG,
    Ridges,
    compact_channel,
    objective,
    ridge,
    triangles,
    usable_columns,
    usable_columns_of,
    weighted_basis,
)
from potr_cl.reference.scenes import random_scene
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor, Weighting
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS, ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from tests.devices import KERNELS, open_device

#: Colour error, in colour units, that is a matter of rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6


@pytest.fixture(scope="module", params=KERNELS)
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a compactor did not give all its memory back"


def dense_weights(dense: NDArray[np.floating]) -> ViewWeights:
    """Weights (N, S), zeros left out."""
    offsets = np.concatenate([[0], np.cumsum((dense > 0).sum(axis=1))])
    return ViewWeights(offsets, np.nonzero(dense)[1].astype(np.int32), dense[dense > 0].astype(np.float32))


def on_a_sphere(views: int, seed: int = 0, distance: float = 6.0) -> NDArray[np.float64]:
    directions = np.random.default_rng(seed).normal(size=(views, 3))
    return distance * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sparse_weights(splats: int, views: int, seed: int = 0) -> NDArray[np.float32]:
    """(N, S), half of them zero, the others spread over five decades; from no view to all a splat."""
    rng = np.random.default_rng(seed)
    weights = 10 ** rng.uniform(-3, 2, size=(splats, views))
    return (weights * (rng.random((splats, views)) < rng.random((splats, 1)))).astype(np.float32)


def channels(sh: NDArray[np.floating], ycocg: bool = True) -> NDArray[np.float64]:
    """(N, M, 3) in the colour model."""
    return sh @ YCOCG.T if ycocg else sh.astype(np.float64)


def check_optimal(
    scene: Scene,
    compacted: Scene,
    centres: NDArray[np.float64],
    dense: NDArray[np.floating],
    options: CompactionOptions,
    rounding: float = ROUNDING,
) -> None:
    """Every channel's objective is within 0.1 % and rounding of the optimum over the coefficients that it left free."""
    ycocg = options.colour_model == "ycocg"
    before, after = channels(scene.sh, ycocg), channels(compacted.sh, ycocg)
    assert np.isfinite(compacted.sh).all()
    for k in range(len(scene)):
        rows = dense[k] > 0
        if not rows.any():
            continue
        weights = dense[k, rows].astype(np.float64)
        basis = weighted_basis(scene.means[k].astype(np.float64), centres[rows], weights, scene.sh_degree)
        for c in range(3):
            lam = options.lam * (options.chroma_factor if ycocg and c else 1)
            # The way through YCoCg and back leaves a rounding error where a coefficient is zero.
            used = np.abs(after[k, :, c]) > 1e-6 * np.abs(compacted.sh[k]).max(initial=1e-30)
            used[0] = True
            best = objective(basis, before[k, :, c], ridge(basis, before[k, :, c], used, lam), lam)
            ours = objective(basis, before[k, :, c], np.where(used, after[k, :, c], 0), lam)
            scale = max(1, np.abs(before[k]).max())
            assert ours <= 1.001 * best + (rounding * scale) ** 2 * np.sum(weights**2), (k, c, ours, best)


@pytest.mark.parametrize("degree", [1, 2, 3])
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
def test_the_definition(device: Device, degree: int, changes: dict[str, object]) -> None:
    options = replace(CompactionOptions(), **changes)  # type: ignore[arg-type]
    scene = random_scene(40, degree, seed=degree)
    centres = on_a_sphere(30)
    dense = sparse_weights(len(scene), 30)
    compacted = Compactor(device).compact(scene, centres, dense_weights(dense), options)
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
def test_everything_but_sh_is_shared(device: Device) -> None:
    scene = random_scene(20)
    compacted = Compactor(device).compact(scene, on_a_sphere(10), dense_weights(sparse_weights(20, 10)))
    for name in ("means", "log_scales", "quaternions", "opacity_logits"):
        assert getattr(compacted, name) is getattr(scene, name)
    assert compacted.sh.shape == scene.sh.shape
    assert compacted.sh.dtype == np.float32


def test_unseen_splats_keep_dc_and_lose_ac(device: Device) -> None:
    scene = random_scene(9)
    dense = sparse_weights(9, 10, seed=1) + np.float32(1e-3)
    dense[[0, 4, 8]] = 0
    compacted = Compactor(device).compact(scene, on_a_sphere(10), dense_weights(dense))
    np.testing.assert_array_equal(compacted.sh[[0, 4, 8], 0], scene.sh[[0, 4, 8], 0])
    assert not compacted.sh[[0, 4, 8], 1:].any()
    nobody = Compactor(device).compact(scene, on_a_sphere(10), dense_weights(0 * dense))
    np.testing.assert_array_equal(nobody.sh[:, 0], scene.sh[:, 0])
    assert not nobody.sh[:, 1:].any()


@pytest.mark.one_runtime
def test_degree_0_is_returned_untouched(device: Device) -> None:
    scene = random_scene(5, degree=0)
    assert Compactor(device).compact(scene, on_a_sphere(3), dense_weights(sparse_weights(5, 3))) is scene


@pytest.mark.one_runtime
def test_an_empty_scene(device: Device) -> None:
    scene = random_scene(3).subset(np.zeros(3, bool))
    assert len(Compactor(device).compact(scene, on_a_sphere(3), dense_weights(np.zeros((0, 3))))) == 0


def test_batches_and_repetition_change_no_byte(device: Device) -> None:
    scene = random_scene(150, seed=3)
    centres, weights = on_a_sphere(20), dense_weights(sparse_weights(150, 20, seed=3))
    whole = Compactor(device).compact(scene, centres, weights)
    for memory in (None, 20_000, 1):
        again = Compactor(device, memory).compact(scene, centres, weights)
        assert again.sh.tobytes() == whole.sh.tobytes()


@pytest.mark.one_runtime
def test_memory_that_runs_out_half_way_is_given_back(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = 0

    def allocate(nbytes: int, what: str) -> object:
        nonlocal taken
        taken += 1
        if taken == 9:  # within the second batch's buffers
            raise DeviceError("full")
        return Device.allocate(device, nbytes, what)

    monkeypatch.setattr(device, "allocate", allocate)
    with pytest.raises(DeviceError, match="full"):
        Compactor(device, 1).compact(random_scene(9), on_a_sphere(4), dense_weights(np.ones((9, 4))))
    assert device.allocated == 0


@pytest.mark.one_runtime
def test_sh_of_any_strides(device: Device) -> None:
    scene = random_scene(30, seed=4)
    strided = replace(scene, sh=np.asfortranarray(scene.sh))
    centres, weights = on_a_sphere(20), dense_weights(sparse_weights(30, 20, seed=4))
    results = [Compactor(device).compact(s, centres, weights).sh.tobytes() for s in (scene, strided)]
    assert results[0] == results[1]


def test_families_agree() -> None:
    scene = random_scene(60, seed=5)
    centres, weights = on_a_sphere(40), dense_weights(sparse_weights(60, 40, seed=5))
    options = CompactionOptions(lam=1e-2, two_pass=False)
    cpu, gpu = (Compactor(Device(family=f)).compact(scene, centres, weights, options) for f in ("cpu", "gpu"))
    np.testing.assert_allclose(cpu.sh, gpu.sh, atol=2e-4)


def test_one_view_needs_no_ac(device: Device) -> None:
    """Whatever lambda: DC alone reproduces one colour exactly."""
    scene = random_scene(10, seed=6)
    centres = on_a_sphere(1)
    for lam in (0.0, 1.0, 1e12):
        for alpha in (0.9, 1.0):
            options = CompactionOptions(lam=lam, alpha=alpha)
            compacted = Compactor(device).compact(scene, centres, dense_weights(np.ones((10, 1))), options)
            for k in range(10):
                basis = weighted_basis(scene.means[k].astype(np.float64), centres, np.ones(1), 3)
                np.testing.assert_allclose(basis @ compacted.sh[k], basis @ scene.sh[k], atol=2e-6)
            assert np.abs(compacted.sh[:, 1:]).max() < 1e-6


def test_lambda_without_end_leaves_the_mean_colour(device: Device) -> None:
    scene = random_scene(10, seed=7)
    centres, dense = on_a_sphere(25), sparse_weights(10, 25, seed=7) + np.float32(0.01)
    compacted = Compactor(device).compact(scene, centres, dense_weights(dense), CompactionOptions(lam=1e20))
    assert np.abs(compacted.sh[:, 1:]).max() < 1e-6
    for k in range(10):
        basis = weighted_basis(scene.means[k].astype(np.float64), centres, np.ones(25), 3)
        squares = dense[k].astype(np.float64) ** 2
        mean = squares @ (basis @ scene.sh[k]) / squares.sum()
        np.testing.assert_allclose(basis[0, 0] * compacted.sh[k, 0], mean, atol=2e-6)


def test_lambda_zero_without_drops_changes_no_colour(device: Device) -> None:
    scene = random_scene(10, seed=8)
    centres, dense = on_a_sphere(40), np.ones((10, 40), np.float32)
    options = CompactionOptions(lam=0, alpha=1, two_pass=False)
    compacted = Compactor(device).compact(scene, centres, dense_weights(dense), options)
    np.testing.assert_allclose(compacted.sh, scene.sh, atol=2e-5)


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


# ------------------------------------------------------------------------------------------------ stress


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


@pytest.mark.parametrize("lam", [0.0, 1e-6, 1.0, 1e6, 1e12])
@pytest.mark.parametrize("alpha", [0.9, 1.0])
@pytest.mark.parametrize("spread", [1.0, 0.1, 1e-2, 1e-3, 1e-5, 0.0])
def test_ill_conditioned_systems(device: Device, lam: float, alpha: float, spread: float) -> None:
    scene = random_scene(24, seed=9)
    scene = replace(scene, means=np.zeros_like(scene.means))
    centres = clustered(40, spread, seed=9)
    rng = np.random.default_rng(9)
    # From all weights alike to 18 decades among them: condition numbers from 1 to far beyond 1e14.
    dense = 10 ** rng.uniform(-1, 1, (24, 40)) ** np.repeat([0, 1, 3], 8)[:, None]
    dense[16:] = 10 ** rng.uniform(-12, 6, (8, 40))
    dense = dense.astype(np.float32)
    options = CompactionOptions(lam=lam, alpha=alpha)
    compacted = Compactor(device).compact(scene, centres, dense_weights(dense), options)
    assert bounded(scene, compacted)
    check_optimal(scene, compacted, centres, dense, options)


def test_the_stress_reaches_condition_numbers_of_1e14() -> None:
    centres = clustered(40, 1e-2, seed=9)
    basis = weighted_basis(np.zeros(3), centres, np.ones(40), 3)
    assert np.linalg.cond(basis / np.linalg.norm(basis, axis=0)) > 1e7  # of the Gram matrix: the square


@pytest.mark.parametrize("weight", [1e-12, 1e-6, 1.0, 1e6])
@pytest.mark.parametrize("lam", [0.0, 1e-6, 1.0, 1e12])
@pytest.mark.parametrize("views", ["one", "opposite", "same place", "ring", "sphere"])
def test_extreme_weights(device: Device, weight: float, lam: float, views: str) -> None:
    centres = {
        "one": on_a_sphere(1),
        "opposite": np.array([[0.0, 6, 0], [0, -6, 0]]),
        "same place": np.tile(on_a_sphere(1), (7, 1)),
        "ring": np.stack([6 * np.cos(np.arange(9)), 6 * np.sin(np.arange(9)), np.zeros(9)], axis=1),
        "sphere": on_a_sphere(50),
    }[views]
    scene = random_scene(10, seed=10)
    scene = replace(scene, means=(0.01 * scene.means * (np.arange(10) > 4)[:, None]).astype(np.float32))
    dense = np.full((10, len(centres)), weight, np.float32)
    for alpha in (0.7, 1.0):
        options = CompactionOptions(lam=lam, alpha=alpha)
        compacted = Compactor(device).compact(scene, centres, dense_weights(dense), options)
        assert bounded(scene, compacted)
        check_optimal(scene, compacted, centres, dense, options)


def test_a_splat_in_a_camera_stays_finite(device: Device) -> None:
    scene = random_scene(4, seed=11)
    centres = np.concatenate([scene.means.astype(np.float64), on_a_sphere(3)])
    assert bounded(scene, Compactor(device).compact(scene, centres, dense_weights(np.ones((4, 7)))))


def test_far_from_the_origin(device: Device) -> None:
    """Directions come from differences of positions with all their digits."""
    scene = random_scene(20, seed=12)
    offset = np.array([3e5, -2e5, 1e5])
    far = replace(scene, means=(scene.means + offset).astype(np.float32))
    near = replace(scene, means=(far.means.astype(np.float64) - offset).astype(np.float32))
    centres = on_a_sphere(30)
    weights = dense_weights(sparse_weights(20, 30, seed=12))
    options = CompactionOptions(lam=0.1, two_pass=False)
    results = [
        Compactor(device).compact(s, c, weights, options).sh for s, c in ((near, centres), (far, centres + offset))
    ]
    np.testing.assert_allclose(*results, atol=1e-4)


def test_a_solution_that_grows_too_much_is_refused(device: Device) -> None:
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
    compacted = Compactor(device).compact(scene, centres, dense_weights(np.ones((2, 11))), options)
    np.testing.assert_array_equal(compacted.sh[0], scene.sh[0])
    assert np.count_nonzero(compacted.sh[1, :, 0]) <= 3


@given(
    seed=st.integers(0, 2**32 - 1),
    views=st.integers(1, 30),
    log_lam=st.floats(-8, 12),
    alpha=st.floats(0.3, 1),
    decades=st.floats(0, 9),
    spread=st.floats(0, 1),
    degree=st.integers(1, 3),
)
@settings(max_examples=30, deadline=None)
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


# ------------------------------------------------------------------------------------------------ variants


@pytest.mark.parametrize("precision", ["plain", "scaled", "refined", "orthogonal", "fp64"])
def test_variants_solve_easy_systems(device: Device, precision: str) -> None:
    if precision == "fp64" and "cl_khr_fp64" not in device.info.handle.extensions:
        pytest.skip("the device has no fp64")
    scene = random_scene(20, seed=14)
    centres, dense = on_a_sphere(60), np.ones((20, 60), np.float32)
    options = replace(CompactionOptions(), precision=precision)  # type: ignore[arg-type]
    compacted = Compactor(device).compact(scene, centres, dense_weights(dense), options)
    check_optimal(scene, compacted, centres, dense, options)


@pytest.mark.one_runtime
def test_fp64_is_refused_where_there_is_none(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    class WithoutDoubles:
        extensions = "cl_khr_fp16"

    monkeypatch.setattr(device, "info", replace(device.info, handle=WithoutDoubles()))
    with pytest.raises(DeviceError, match="no double precision"):
        Compactor(device).compact(
            random_scene(3),
            on_a_sphere(3),
            dense_weights(np.ones((3, 3))),
            CompactionOptions(precision="fp64"),
        )


# ------------------------------------------------------------------------------------------------ real weights


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


def scaled(camera: Camera, factor: float) -> Camera:
    """The same view in another resolution."""
    size = {name: round(getattr(camera, name) * factor) for name in ("width", "height")}
    return replace(camera, **size, **{name: getattr(camera, name) * factor for name in ("fx", "fy", "cx", "cy")})


def test_half_the_resolution_gives_the_same_sparsity(plush_excerpt: Scene, plush_excerpt_cameras: list[Camera]) -> None:
    """From 480 x 360 to 240 x 180; the rasterizer's dilation by 0.3 pixels hardly matters yet."""
    device = Device()
    views = train_views(plush_excerpt_cameras)
    sparsity = []
    for factor in (2, 1):
        weights = measured_weights(device, plush_excerpt, [scaled(c, factor) for c in views])
        sparsity.append(zeros(Compactor(device).compact(plush_excerpt, camera_centres(views), weights).sh))
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


# ------------------------------------------------------------------------------------------------ bad calls


@pytest.mark.one_runtime
def test_views_that_do_not_belong_to_the_scene(device: Device) -> None:
    scene, weights = random_scene(5), dense_weights(np.ones((5, 4)))
    compactor = Compactor(device)
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


@pytest.mark.parametrize(
    "changes",
    [
        {"lam": -1.0},
        {"lam": float("nan")},
        {"lam": 1e30},
        {"chroma_factor": -1.0},
        {"alpha": 0.0},
        {"alpha": 1.5},
        {"sf_sh": 0.0},
        {"colour_model": "cmyk"},
        {"weighting": "heavy"},
        {"precision": "fp8"},
    ],
)
def test_options_out_of_range(changes: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        replace(CompactionOptions(), **changes)  # type: ignore[arg-type]
