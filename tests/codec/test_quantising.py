"""The encoder's loops over all splats in C: the same bits as NumPy's, and nothing beyond their arrays."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from potr_cl.codec import quantize
from potr_cl.codec.colours import colour_levels
from potr_cl.codec.geometry import quantise_geometry
from potr_cl.codec.median import median
from potr_cl.codec.native.library import VARIABLE, native
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.splat_levels import splat_levels
from potr_cl.errors import DataError
from potr_cl.raster.activation import unit_quaternions
from potr_cl.stages.refitting.refit import active_coefficients
from tests.reference.scenes import random_scene, tilted_camera


@pytest.fixture
def both(monkeypatch):
    """Calls something by NumPy and by the compiled library; skips where there is none."""
    monkeypatch.delenv(VARIABLE, raising=False)
    if native() is None:
        pytest.skip("the compiled library is not there: python -m tools.make.native, or pip install -e .")

    def called(work):
        results = []
        for value in ("0", "1"):
            monkeypatch.setenv(VARIABLE, value)
            results.append(work())
        return results

    return called


def assert_same_bits(a, b):
    assert (a.dtype, a.shape) == (b.dtype, b.shape)
    assert np.ascontiguousarray(a).tobytes() == np.ascontiguousarray(b).tobytes()


def axis_rotations() -> np.ndarray:
    """Quaternions of which several equivalent forms have the same real part, and their negatives."""
    half, root = 0.5, np.sqrt(0.5)
    some = [[1, 0, 0, 0], [0, 0, 1, 0], [half] * 4, [half, -half, half, -half], [root, root, 0, 0], [0, root, 0, -root]]
    return np.array(some + [[-x for x in q] for q in some], np.float32)


@pytest.mark.parametrize("number", [0, 1, 255, 256, 257, 5000])
def test_canonical_rotations(number, both):
    rng = np.random.default_rng(number)
    quaternions = rng.normal(0, 1, (5000, 4)).astype(np.float32) * rng.lognormal(0, 4, (5000, 1)).astype(np.float32)
    quaternions[:12] = axis_rotations()
    log_scales = rng.normal(0, 2, (5000, 3)).astype(np.float32)
    order = rng.permutation(5000)[:number]
    ours, wanted = both(lambda: quantize.canonical_rotations(quaternions, log_scales, order))
    for a, b in zip(ours, wanted, strict=True):
        assert_same_bits(a, b)


def test_all_splats_are_taken_without_an_order(both):
    rotations, scales = axis_rotations(), np.arange(36, dtype=np.float32).reshape(12, 3)
    for imaginary, turned in both(lambda: quantize.canonical_rotations(rotations, scales)):
        assert imaginary.shape == turned.shape == (12, 3)
        assert (np.linalg.norm(imaginary, axis=1) < 0.53).all()  # the real part is 0.85 or more


@pytest.mark.parametrize("number", [0, 1, 1000])
def test_unit_quaternions_are_those_of_the_rasterizer(number):
    functions = native()
    if functions is None:
        pytest.skip("the compiled library is not there: python -m tools.make.native, or pip install -e .")
    rng = np.random.default_rng(number)
    quaternions = rng.normal(0, 1, (number, 4)).astype(np.float32) * rng.lognormal(0, 9, (number, 1)).astype(np.float32)
    quaternions[::7] = 0
    assert_same_bits(
        functions.quantising.unit_quaternions(quaternions), unit_quaternions(quaternions).astype(np.float32)
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("number", [1, 63, 64, 65, 1000])
def test_coefficients_that_are_not_rounded_to_zero(degree, number, both):
    sh = random_scene(number, degree, seed=number).sh
    sh[::3] = np.round(sh[::3] * 20) / 20  # between two levels, exactly
    sh[::5] = 0
    ours, wanted = both(lambda: quantize.nonzero_levels(sh, 10.0))
    assert_same_bits(ours, wanted)
    assert ours.shape == sh.shape
    assert 0 < np.count_nonzero(ours) < ours.size or number == 1
    assert active_coefficients(sh, 10.0)[:, 0].all()


@pytest.mark.parametrize("value", [1e20, np.inf, np.nan])
def test_coefficients_without_a_level_are_refused_alike(value, monkeypatch):
    sh = random_scene(70, 1, seed=1).sh
    sh[69, 3, 2] = value
    for path in ("0", "") if native() is not None else ("0",):
        monkeypatch.setenv(VARIABLE, path)
        with np.errstate(invalid="ignore"), pytest.raises(DataError, match="SH coefficient"):
            quantize.nonzero_levels(sh, 10.0)


@pytest.mark.parametrize("largest", [0.0, 100.0, 1023.0, 40_000.0, 1e9])
@pytest.mark.parametrize("layout", ["rows", "columns", "neither"])
def test_levels_of_colours(largest, layout, both):
    """Levels of 16, 32 and 64 bits; halves between two levels; the classes of some splats, or of none."""
    rng = np.random.default_rng(7)
    number, count = 40_000, 4
    sh = (rng.normal(0, 0.3, (number, count, 3)) * rng.choice([0, 1, 3], (number, 1, 3))).astype(np.float32)
    sh[:100] = np.round(sh[:100] * 64) / 64
    sh[number // 2, 1] = (largest, -largest, largest / 2)
    if layout == "columns":
        sh = np.ascontiguousarray(sh.transpose(1, 2, 0)).transpose(2, 0, 1)
    elif layout == "neither":
        sh = np.repeat(sh, 2, axis=0)[::2]
    parameters = replace(HyperParameters.from_quality(0.5, "best"), sf_dc=64.0, sf_sh=32.0)
    some = rng.integers(-9, 9, number).astype(np.int8)
    for classes in ((some, some[::-1].copy()), (np.zeros(number, np.int8), some)):
        for order in (rng.permutation(number), np.arange(number - 7)):
            chosen = tuple(each[: len(order)] for each in classes)
            a, b = both(partial(colour_levels, sh[: len(order)], order, parameters, chosen, map))
            assert_same_bits(a, b)
            assert a.dtype == (np.int16 if largest * 64 < 2**15 else np.int32 if largest < 1e6 else np.int64)


@pytest.mark.parametrize("views", [0, 1, 5])
def test_geometry(views, both):
    scene = random_scene(3000, 0, seed=4)
    scene = replace(scene, means=scene.means * np.float32(100))
    cameras = [tilted_camera(view, 64, 64) for view in range(views)]
    a, b = both(lambda: quantise_geometry(scene, HyperParameters.from_quality(0.5, "best"), cameras))
    assert a.parameters == b.parameters
    assert_same_bits(a.order, b.order)
    for name in ("scales", "rotations"):
        for ours, wanted in zip(getattr(a, name), getattr(b, name), strict=True):
            assert_same_bits(ours, wanted)
    assert_same_bits(a.tree.tails, b.tree.tails)


@pytest.mark.parametrize("case", ["usual", "wide", "beyond 32 bits", "balls", "antialiased"])
@pytest.mark.parametrize("number", [1, 700, 40_000])
def test_levels_of_splats(case, number, both):
    """In the types that NumPy chooses, of some of the splats; on halves between two levels as well."""
    scene = random_scene(number, 0, seed=number)
    world = replace(HyperParameters.from_quality(0.5, "best"), sf_scale=50.0, sf_opacity=4.0)
    scene.opacity_logits[::3] = np.round(scene.opacity_logits[::3] * 8) / 8
    scene.opacity_logits[::50] = 100
    if case == "wide":
        scene.log_scales[number // 2] = (8, 9, 10)
    elif case == "beyond 32 bits":
        scene.log_scales[number // 2] = 20
    elif case == "balls":
        scene.log_scales[:] = scene.log_scales[:, :1]
    order = np.random.default_rng(1).permutation(number)[: max(number * 2 // 3, 1)]
    order[0] = number // 2
    a, b = both(lambda: splat_levels(scene, order, world))
    for ours, theirs in zip(
        (*a.scales, *a.rotations, a.opacities), (*b.scales, *b.rotations, b.opacities), strict=True
    ):
        assert_same_bits(ours, theirs)
    assert a.scales[0].dtype == {"wide": np.int32, "beyond 32 bits": np.int64}.get(case, np.int16)
    if case == "balls":
        assert not np.any(a.rotations)


def test_levels_that_no_number_holds_are_refused_alike(monkeypatch):
    scene = random_scene(500, 0, seed=1)
    scene.log_scales[77, 1] = 60
    for path in ("0", "") if native() is not None else ("0",):
        monkeypatch.setenv(VARIABLE, path)
        with pytest.raises(DataError, match=r"a standard deviation of .* is too large to quantise"):
            splat_levels(scene, np.arange(500), HyperParameters.from_quality(0.5, "best"))


@pytest.mark.parametrize("number", [1, 2, 999, 70_001, 200_000])
@pytest.mark.parametrize("kind", ["normal", "alike", "sorted", "few"])
def test_medians_are_numpys(number, kind):
    values = np.random.default_rng(number).lognormal(0, 5, number)
    if kind == "alike":
        values[:] = values[0]
    elif kind == "sorted":
        values.sort()
    elif kind == "few":
        values = np.round(values)
    assert median(values) == np.median(values)
    assert median(values[:0]) is None


def test_what_does_not_fit_is_refused_before_c_sees_it():
    functions = native()
    if functions is None:
        pytest.skip("the compiled library is not there: python -m tools.make.native, or pip install -e .")
    quantising = functions.quantising
    ones, sh = np.ones((4, 3), np.float32), np.ones((4, 1, 3), np.float32)
    with pytest.raises(TypeError):
        quantising.nearest(ones, np.ones((2, 3)), np.empty(5))
    doubles, logits, numbers = np.ones((4, 3)), np.ones(4, np.float32), np.arange(4)
    for order, start, columns in ((numbers + 1, 0, 7), (numbers, 1, 7), (numbers, -1, 7), (numbers, 0, 6)):
        with pytest.raises(TypeError):
            quantising.splat_levels(
                np.ones((4, 4), np.float32), doubles, logits, order, *quantize.AXIS_ROTATIONS, (1.0, 1.0, 1.0),
                (0.0, 1.0), start, np.empty((columns, 4), np.int32),
            )  # fmt: skip
    with pytest.raises(TypeError):
        quantising.nearest(ones.astype(np.float64), np.ones((2, 3)), np.empty(4))  # type: ignore[arg-type]
    order, factors, levels = np.arange(4), np.ones(4), np.empty((1, 3, 4), np.int16)
    for arguments in (
        (sh.astype(np.float64), False, order, factors, factors, 0, levels),
        (sh.transpose(2, 1, 0), True, order, factors, factors, 0, levels),
        (sh, True, order, factors, factors, 0, levels),
        (sh, False, order + 1, factors, factors, 0, levels),
        (sh, False, order - 1, factors, factors, 0, levels),
        (sh, False, order, factors[:3], factors, 0, levels),
        (sh, False, order, factors, factors[:3], 0, levels),
        (sh, False, order, factors, factors, 1, levels),
        (sh, False, order, factors, factors, -1, levels),
        (sh, False, order, factors, factors, 0, levels.astype(np.int32)),
    ):
        with pytest.raises(TypeError):
            quantising.colour_levels(*arguments)
    for number in (-1, 4):
        with pytest.raises(TypeError, match="not there"):
            quantising.canonical(
                np.ones((4, 4), np.float32), ones, np.array([number]), np.ones((4, 24)), np.zeros((24, 3), np.uint8),
                np.empty((1, 3)), np.empty((1, 3), np.float32),
            )  # fmt: skip
