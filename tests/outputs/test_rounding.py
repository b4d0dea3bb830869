"""How colours are rounded: levels by rate and distortion, coarser ones where an error matters less, and in turn."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.outputs.feedback import DAMPING, rounded_in_turn
from potr_cl.outputs.level_choice import chosen_levels
from potr_cl.outputs.sog import STEP_OF_BIT, graded


def bits(levels):
    frequency = np.bincount(levels.ravel(), minlength=256) / levels.size
    used = frequency[frequency > 0]
    return float(-(used * np.log2(used)).sum() * levels.size)


@pytest.fixture(scope="module")
def levels():
    values = np.random.default_rng(0).laplace(0, 12, (4000, 15, 3))
    return np.clip(np.round(values) + 128, 0, 255).astype(np.uint8)


def test_fewer_bits_for_errors_that_are_worth_less(levels):
    worth = np.full(levels.shape[:2], 0.02, np.float32)
    chosen = chosen_levels(levels, worth)
    errors = (chosen.astype(float) - levels) ** 2
    saved = bits(levels) - bits(chosen)
    assert saved > 0.4 * bits(levels)
    assert 0.02 * errors.sum() < saved, "the errors are worth more than the bits that they save"


@pytest.mark.parametrize("worth", [0.02, 0.2])
def test_better_than_any_uniform_coarsening(levels, worth):
    def cost(chosen):
        return bits(chosen) + worth * ((chosen.astype(float) - levels) ** 2).sum()

    uniform = [
        np.clip((levels.astype(int) - 128 + b // 2) // b * b + 128, 0, 255).astype(np.uint8)
        for b in (1, 2, 4, 8, 16, 32)
    ]
    chosen = chosen_levels(levels, np.full(levels.shape[:2], worth, np.float32))
    assert cost(chosen) < min(map(cost, uniform))


def test_each_coefficient_is_weighed_by_itself(levels):
    worth = np.where(np.arange(len(levels)) % 2, 1e5, 0.01)[:, None] * np.ones(levels.shape[1])
    chosen = chosen_levels(levels, worth.astype(np.float32))
    assert np.array_equal(chosen[1::2], levels[1::2])
    assert len(np.unique(chosen[::2])) < len(np.unique(levels[::2])) / 2


def test_threads_make_no_difference(levels):
    worth = np.random.default_rng(1).lognormal(0, 3, levels.shape[:2]).astype(np.float32)
    assert np.array_equal(chosen_levels(levels, worth, 1), chosen_levels(levels, worth, 4))


def test_what_nobody_sees_keeps_its_colour_about():
    levels = np.array([[[128, 140, 200]]], np.uint8).repeat(50, axis=0)
    chosen = chosen_levels(levels, np.zeros((50, 1), np.float32))
    assert np.abs(chosen.astype(int) - levels).max() <= 72


def normal(count, channels=3):
    return np.random.default_rng(1).normal(size=(count, channels)).astype(np.float32)


def test_even_steps_follow_what_an_error_is_worth():
    values = normal(5000)
    for step in (0.1, 0.4):
        worth = np.full(5000, STEP_OF_BIT / step**2, np.float32)
        found = graded(values, worth)
        apart = np.diff(found.book.astype(np.float64))
        assert np.median(apart) == pytest.approx(step / 2, rel=1e-5)
        # All take the same: every second level.
        errors = np.abs(found.values - values)[np.abs(values).max(axis=1) < 3]
        assert errors.max() < 0.501 * step


def test_what_matters_less_is_coarser():
    values = normal(4000)
    worth = np.repeat([400, 4], 2000).astype(np.float32)
    found = graded(values, worth)
    errors = np.square(found.values - values).mean(axis=1)
    assert errors[2000:].mean() > 10 * errors[:2000].mean()
    assert len(np.unique(found.levels[2000:])) < len(np.unique(found.levels[:2000])) / 2


def test_no_more_than_256_levels_however_fine():
    values = normal(4000)
    found = graded(values, np.full(4000, 1e12, np.float32))
    assert len(found.book) <= 256
    assert 0 in found.book
    assert np.square(found.values - values).mean() < 1e-3


@pytest.mark.parametrize("worth", [0.0, 1e-20, 1e20])
def test_numbers_far_out_are_near_what_they_were(worth):
    values = normal(4000, 1)
    values[7], values[9] = 1000, -500
    found = graded(values, np.full(4000, worth, np.float32))
    assert np.isfinite(found.values).all()
    if worth > 1:
        assert found.values[7] == pytest.approx(1000, rel=0.01)
        assert found.values[9] == pytest.approx(-500, rel=0.01)


@pytest.mark.parametrize("values", [np.zeros((5, 3)), np.full((1, 3), 2.5)])
def test_numbers_without_extent(values):
    found = graded(values.astype(np.float32), np.full(len(values), 1000, np.float32))
    assert found.values == pytest.approx(values, abs=0.1)


def test_coefficients_are_rounded_in_turn_to_the_nearest_plane_of_each_splat():
    rng = np.random.default_rng(0)
    count, coefficients = 5000, 9
    sh = rng.normal(0, 0.3, (count, coefficients, 3)).astype(np.float32)
    seen = rng.normal(size=(count, 20, coefficients)) * rng.lognormal(0, 2, (count, 1, 1))
    seen[::50] = 0  # of no view
    blocks = np.einsum("nva,nvb->nab", seen, seen).astype(np.float32)
    rows, columns = np.triu_indices(coefficients)

    def quantise(coefficient, wanted, splats):
        assert wanted.shape == (3, len(sh[splats]))
        return np.rint(wanted * 8) / np.float32(8)

    found = rounded_in_turn(sh, np.ascontiguousarray(blocks[:, rows, columns].T), quantise, threads=2)
    size = np.trace(blocks, axis1=1, axis2=2).astype(np.float64) / coefficients
    for n in [*range(0, count, 37), 0, 50, 100]:
        metric = np.eye(coefficients)
        if size[n] > 1e-30:
            metric = blocks[n].astype(np.float64) + DAMPING * size[n] * metric
        upper = np.linalg.cholesky(metric).T
        error = np.zeros((coefficients, 3))
        for m in range(coefficients - 1, 0, -1):
            wanted = sh[n, m] + upper[m, m + 1 :] @ error[m + 1 :] / upper[m, m]
            if (np.abs(wanted * 8 % 1 - 0.5) < 1e-3).any():  # a toss-up
                break
            assert np.array_equal(found[n, m], np.rint(wanted * 8) / 8), (n, m)
            error[m] = sh[n, m] - found[n, m]
        else:
            assert np.allclose(found[n, 0], sh[n, 0] + upper[0, 1:] @ error[1:] / upper[0, 0], atol=1e-4)
    assert np.array_equal(found[::50, 1:], np.rint(sh[::50, 1:] * 8) / 8)
