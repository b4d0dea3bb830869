"""The encoder's loops over all splats: what they refuse, and that C is given nothing beyond its arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from potr_cl.codec import quantize
from potr_cl.codec.native import quantising
from potr_cl.codec.native.library import VARIABLE, native
from potr_cl.codec.quantisers import median
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.splat_levels import splat_levels
from potr_cl.errors import DataError
from potr_cl.raster.activation import unit_quaternions
from potr_cl.stages.refitting.refit import active_coefficients
from tests.reference.scenes import random_scene


@pytest.mark.parametrize("number", [0, 1, 1000])
def test_unit_quaternions_are_those_of_the_rasterizer(number):
    functions = native()
    if functions is None:
        pytest.skip("the compiled library is not there: python -m tools.make.native, or pip install -e .")
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


@pytest.mark.parametrize("value", [1e20, np.inf, np.nan])
def test_coefficients_without_a_level_are_refused_alike(value, monkeypatch):
    sh = random_scene(70, 1, seed=1).sh
    sh[69, 3, 2] = value
    for path in ("0", "") if native() is not None else ("0",):
        monkeypatch.setenv(VARIABLE, path)
        with np.errstate(invalid="ignore"), pytest.raises(DataError, match="SH coefficient"):
            quantize.nonzero_levels(sh, 10.0)


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
