"""Levels that are coarser where an error matters less."""

import numpy as np
import pytest

from potr_cl.outputs.sog import STEP_OF_BIT, graded


def test_even_steps_follow_what_an_error_is_worth():
    values = np.random.default_rng(1).normal(size=(5000, 3)).astype(np.float32)
    for step in (0.1, 0.4):
        worth = np.full(5000, STEP_OF_BIT / step**2, np.float32)
        found = graded(values, worth)
        apart = np.diff(found.book.astype(np.float64))
        assert np.median(apart) == pytest.approx(step / 2, rel=1e-5)
        # All take the same: every second level.
        errors = np.abs(found.values - values)[np.abs(values).max(axis=1) < 3]
        assert errors.max() < 0.501 * step


def test_what_matters_less_is_coarser():
    values = np.random.default_rng(1).normal(size=(4000, 3)).astype(np.float32)
    worth = np.repeat([400, 4], 2000).astype(np.float32)
    found = graded(values, worth)
    errors = np.square(found.values - values).mean(axis=1)
    assert errors[2000:].mean() > 10 * errors[:2000].mean()
    assert len(np.unique(found.levels[2000:])) < len(np.unique(found.levels[:2000])) / 2


def test_no_more_than_256_levels_however_fine():
    values = np.random.default_rng(1).normal(size=(4000, 3)).astype(np.float32)
    found = graded(values, np.full(4000, 1e12, np.float32))
    assert len(found.book) <= 256
    assert 0 in found.book
    assert np.square(found.values - values).mean() < 1e-3


@pytest.mark.parametrize("worth", [0.0, 1e-20, 1e20])
def test_numbers_far_out_are_near_what_they_were(worth):
    values = np.random.default_rng(1).normal(size=(4000, 1)).astype(np.float32)
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
