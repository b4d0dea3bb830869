"""Quantiser: half a step at the most, rotations that leave the covariance, hyper-parameters; its loops in C."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec import quantize
from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.codec.native import quantising
from potr_cl.codec.quantisers import median
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.splat_levels import splat_levels
from potr_cl.errors import DataError, UsageError
from potr_cl.native.library import VARIABLE, native
from potr_cl.raster.activation import unit_quaternions
from potr_cl.stages.refitting.refit import active_coefficients
from tests.reference.raster import rotation_matrices
from tests.reference.scenes import random_scene

NEEDS_LIBRARY = pytest.mark.skipif(native() is None, reason="the compiled library is not there")

HALF = 0.5 + 1e-6  # steps; the float32 result adds its own rounding, checked apart


def covariance(quaternions, log_scales):
    half = rotation_matrices(quaternions) * np.exp(log_scales)[:, None, :]
    return half @ half.transpose(0, 2, 1)


def test_paper_values():
    p = HyperParameters.from_quality(0.5)
    assert (p.sf_sh, p.sf_opacity, p.sf_rotation, p.sf_scale) == (51, 101, 201, 2001)
    assert p.beta == pytest.approx(7e-5)
    assert p.gamma == pytest.approx(5e-3 * 10**-2.5)
    assert p.lam == pytest.approx(10**-0.5)
    assert p.alpha == pytest.approx(0.8175745)
    assert p.delta_mse_max == pytest.approx(10**-9.8)
    low = HyperParameters.from_quality(0)
    assert (low.beta, low.gamma, low.sf_sh) == (0, 5e-3, 1)


def test_single_values_replace():
    p = HyperParameters.from_quality(0.5, sf_sh=20, beta=None)
    assert (p.sf_sh, p.sf_dc) == (20, 20)  # one factor for all of SH in the paper
    assert p.beta == pytest.approx(7e-5)
    assert HyperParameters.from_quality(0.5, sf_sh=20, sf_dc=30).sf_dc == 30
    best = HyperParameters.from_quality(0.5, "best")
    assert HyperParameters.from_quality(0.5, "best", sf_sh=20).sf_dc == best.sf_dc


def test_presets():
    assert HyperParameters.from_quality(0.5).quantiser == 0
    for other in ("fast", "smallest"):
        assert HyperParameters.from_quality(0.3, "best") == HyperParameters.from_quality(0.3, other)
    coarse, fine = (HyperParameters.from_quality(q, "best") for q in (0.2, 0.7))
    assert coarse.quantiser == fine.quantiser == 1
    for name in ("sf_dc", "sf_sh", "sf_opacity", "sf_rotation", "sf_scale"):
        assert getattr(coarse, name) < getattr(fine, name)
    assert coarse.beta > fine.beta
    with pytest.raises(UsageError, match="preset"):
        HyperParameters.from_quality(0.5, "tiny")


def test_logits_come_back_within_half_a_step():
    logits = np.linspace(-8, 12, 1001)
    back = quantize.dequantize_logits(quantize.quantize_logits(logits, 5.5), 5.5)
    assert np.abs(back - logits).max() <= 0.5 / 5.5 + 2e-6  # float32 rounds numbers up to 20
    extremes = quantize.dequantize_logits(quantize.quantize_logits(np.array([-50.0, 50.0]), 5.5), 5.5)
    assert np.allclose(extremes, (-8, 12), atol=HALF / 5.5)


@pytest.mark.parametrize("bad", [{"q": -0.1}, {"q": 1.1}, {"q": float("nan")}, {"gamma": 0}, {"sf_sh": 0},
                                 {"sf_scale": float("inf")}, {"beta": -1}])  # fmt: skip
def test_out_of_range(bad):
    with pytest.raises(UsageError):
        HyperParameters.from_quality(**{"q": 0.5, **bad})


QUATERNIONS = hnp.arrays(
    np.float32, st.tuples(st.integers(1, 30), st.just(4)), elements=st.floats(-1, 1, width=32)
).filter(lambda q: (np.linalg.norm(q, axis=1) > 1e-3).all())


@given(QUATERNIONS, st.integers(0, 2**32 - 1))
def test_canonical_rotation_leaves_the_covariance(quaternions, seed):
    log_scales = np.random.default_rng(seed).uniform(-8, 2, size=(len(quaternions), 3)).astype(np.float32)
    imaginary, scales = quantize.canonical_rotations(quaternions, log_scales)
    real = np.sqrt(np.maximum(0, 1 - (imaginary**2).sum(axis=1)))
    assert (real >= 0.85).all()
    canonical = np.concatenate([real[:, None], imaginary], axis=1)
    expected = covariance(quaternions.astype(np.float64), log_scales.astype(np.float64))
    got = covariance(canonical, scales.astype(np.float64))
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert (np.abs(got - expected) <= 1e-6 * size).all()


@given(hnp.arrays(np.float64, st.integers(1, 50), elements=st.floats(-20, 20)), st.floats(1, 4001))
def test_scales(log_scales, sf):
    back = quantize.dequantize_scales(quantize.quantize_scales(log_scales, sf), sf)
    true = np.exp(log_scales)
    assert back.dtype == np.float32
    assert np.isfinite(back).all()
    # A logarithm of size 20 in float32 is good to 1e-6 of the value.
    assert (np.abs(np.exp(back.astype(np.float64)) - true) <= HALF / sf + 3e-6 * true).all()


@given(hnp.arrays(np.float64, st.integers(1, 50), elements=st.floats(-60, 60)), st.floats(1, 201))
def test_opacities(logits, sf):
    back = quantize.dequantize_opacities(quantize.quantize_opacities(logits, sf), sf)
    assert np.isfinite(back).all()
    opacity = 1 / (1 + np.exp(-back.astype(np.float64)))
    true = 1 / (1 + np.exp(-logits))
    # Half a step, and the quarter by which the paper shifts the reconstruction.
    assert (np.abs(opacity - true) <= (HALF + 0.25) / sf + 1e-6).all()


@given(hnp.arrays(np.float64, (20, 3), elements=st.floats(-100, 100)), st.floats(1, 101))
def test_sh(rgb, sf):
    y, co, cg = quantize.to_ycocg(rgb)
    assert np.allclose(np.stack([y + co - cg, y + cg, y - co - cg], 1), rgb)
    for values in (y, co, cg):
        levels = quantize.quantize_sh(values, sf)
        assert (np.abs(levels / sf - values) <= HALF / sf).all()


def test_ac_sparsity():
    sh = np.zeros((4, 4, 3), np.float32)
    assert quantize.ac_sparsity(sh, 51) == 1
    sh[0, 1] = 1  # a grey: Y only
    assert quantize.ac_sparsity(sh, 51) == 35 / 36
    sh[:, 0] = 5  # DC does not count
    assert quantize.ac_sparsity(sh, 51) == 35 / 36
    assert quantize.ac_sparsity(sh[:, :1], 51) == 1


# The same bits on every processor ------------------------------------------------------------------------------------


def nearest_logarithm(value: float) -> np.float32:
    """By decimal arithmetic with far more digits than a tie could need."""
    with localcontext() as context:
        context.prec = 60
        exact = Decimal(value).ln()
        near = np.float32(float(exact))
        around = [np.nextafter(near, np.float32(-np.inf)), near, np.nextafter(near, np.float32(np.inf))]
        return min(around, key=lambda candidate: abs(Decimal(float(candidate)) - exact))


def test_the_logarithm_is_the_nearest_there_is():
    rng = np.random.default_rng(5)
    values = np.exp2(rng.uniform(-33, 76, 1500)).astype(np.float32)
    near_one = 1 + rng.uniform(-1e-3, 1e-3, 300).astype(np.float32)
    hard = [float.fromhex("0x1.bacb4ap+25"), 1, 2.0**-33, np.sqrt(0.5), np.nextafter(np.float32(1), np.float32(0))]
    values = np.concatenate([values, near_one, np.array(hard, np.float32)]).astype(np.float32)
    expected = np.array([nearest_logarithm(float(value)) for value in values])
    assert np.array_equal(natural_logarithm(values), expected)


@pytest.mark.parametrize("factor", [0.001, 1.0, 2001.0, 1e9])
def test_levels_beyond_the_tables_are_as_those_in_them(factor):
    """Whatever else is in a block: a table, a larger table, or none."""
    levels = np.array([0, 1, 2, 255, 256, 257, 65535, 65536, 65537, 1 << 20, 1 << 40], np.int64)
    for dequantise in (quantize.dequantize_scales, quantize.dequantize_opacities):
        together = dequantise(levels, factor)
        assert together.dtype == np.float32
        assert np.array_equal(together, np.concatenate([dequantise(level[None], factor) for level in levels]))
    scales = np.maximum(levels.astype(np.float32), np.float32(0.25)) / np.float32(factor)
    assert np.array_equal(quantize.dequantize_scales(levels, factor), [nearest_logarithm(float(s)) for s in scales])


# The loops over all splats --------------------------------------------------------------------------------------------


@NEEDS_LIBRARY
@pytest.mark.parametrize("number", [0, 1, 1000])
def test_unit_quaternions_are_those_of_the_rasterizer(number):
    functions = native()
    rng = np.random.default_rng(number)
    quaternions = rng.normal(0, 1, (number, 4)).astype(np.float32) * rng.lognormal(0, 9, (number, 1)).astype(np.float32)
    quaternions[::7] = 0
    ours, wanted = quantising.unit_quaternions(functions, quaternions), unit_quaternions(quaternions).astype(np.float32)
    assert (ours.dtype, ours.tobytes()) == (wanted.dtype, wanted.tobytes())


def test_splats_have_the_narrowest_levels_and_balls_no_direction():
    world = replace(HyperParameters.from_quality(0.5, "best"), sf_scale=50.0)
    for largest, wanted in ((0, np.int16), (10, np.int32), (20, np.int64)):
        scene = random_scene(70, 0, seed=1)
        scene.log_scales[:] = scene.log_scales[:, :1]
        scene.log_scales[9] = largest
        levels = splat_levels(scene, np.arange(70), world)
        assert levels.scales[0].dtype == wanted
        assert not np.any(levels.rotations)


def test_coefficients_that_are_not_rounded_to_zero():
    sh = random_scene(1000, 3, seed=1).sh
    assert 0 < np.count_nonzero(quantize.nonzero_levels(sh, 10.0)) < sh.size
    assert active_coefficients(sh, 10.0)[:, 0].all()


@pytest.mark.parametrize("path", ["0", ""], ids=["numpy", "default"])
def test_values_without_a_level_are_refused_alike(path, monkeypatch):
    monkeypatch.setenv(VARIABLE, path)
    scene = random_scene(70, 1, seed=1)
    scene.log_scales[7, 1] = 60
    with pytest.raises(DataError, match=r"a standard deviation of .* is too large to quantise"):
        splat_levels(scene, np.arange(70), HyperParameters.from_quality(0.5, "best"))
    for value in (1e20, np.inf, np.nan):
        scene.sh[69, 3, 2] = value
        with np.errstate(invalid="ignore"), pytest.raises(DataError, match="SH coefficient"):
            quantize.nonzero_levels(scene.sh, 10.0)


@pytest.mark.parametrize("number", [1, 2, 70_001, 200_000])
def test_medians_are_numpys(number):
    values = np.random.default_rng(number).lognormal(0, 5, number)
    for each in (values, np.full(number, 3.5), np.sort(values), np.round(values)):
        assert median(each) == np.median(each)
    assert median(values[:0]) is None


@NEEDS_LIBRARY
def test_what_does_not_fit_is_refused_before_c_sees_it():
    functions = native()
    ones, sh = np.ones((4, 3), np.float32), np.ones((4, 1, 3), np.float32)
    with pytest.raises(TypeError):
        quantising.nearest(functions, ones, np.ones((2, 3)), np.empty(5))
    doubles, logits, numbers = np.ones((4, 3)), np.ones(4, np.float32), np.arange(4)
    for order, start, columns in ((numbers + 1, 0, 7), (numbers, 1, 7), (numbers, -1, 7), (numbers, 0, 6)):
        with pytest.raises(TypeError):
            quantising.splat_levels(functions,
                np.ones((4, 4), np.float32), doubles, logits, order, *quantize.AXIS_ROTATIONS, (1.0, 1.0, 1.0),
                (0.0, 1.0), start, np.empty((columns, 4), np.int32),
            )  # fmt: skip
    with pytest.raises(TypeError):
        quantising.nearest(functions, ones.astype(np.float64), np.ones((2, 3)), np.empty(4))  # type: ignore[arg-type]
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
            quantising.colour_levels(functions, *arguments)
    for number in (-1, 4):
        with pytest.raises(TypeError, match="not there"):
            quantising.canonical(functions,
                np.ones((4, 4), np.float32), ones, np.array([number]), np.ones((4, 24)), np.zeros((24, 3), np.uint8),
                np.empty((1, 3)), np.empty((1, 3), np.float32),
            )  # fmt: skip
