"""Levels chosen by rate and distortion."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.outputs.level_choice import chosen_levels


def bits(levels):
    frequency = np.bincount(levels.ravel(), minlength=256) / levels.size
    used = frequency[frequency > 0]
    return float(-(used * np.log2(used)).sum() * levels.size)


@pytest.fixture(scope="module")
def levels():
    values = np.random.default_rng(0).laplace(0, 12, (4000, 15, 3))
    return np.clip(np.round(values) + 128, 0, 255).astype(np.uint8)


def test_what_is_worth_much_keeps_its_level(levels):
    assert np.array_equal(chosen_levels(levels, np.full(levels.shape[:2], 1e6, np.float32)), levels)


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
