"""Few numbers for many, and points along Hilbert's curve."""

import numpy as np
import pytest

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.clustering.curve import along_curve


def test_few_numbers_stay_as_they_are():
    values = np.array([3, -1, 3, 0.1, -1], np.float32)
    assert codebook(values, None, 3).tolist() == [-1, np.float32(0.1), 3]


def test_the_error_is_near_that_of_the_best_book():
    values = np.random.default_rng(1).normal(size=20000).astype(np.float32)
    book = codebook(values, None, 256)
    assert len(book) == 256
    error = np.square(values - book[nearest(values, book)], dtype=np.float64).mean()
    # Panter and Dite: the least error of many levels for a normal density is sqrt(3) pi / (2 levels^2).
    assert error < 1.15 * np.sqrt(3) * np.pi / (2 * 256**2)


def test_what_weighs_more_is_nearer():
    values = np.concatenate([np.linspace(0, 1, 5000), np.linspace(10, 11, 5000)]).astype(np.float32)
    weights = np.repeat([1.0, 100.0], 5000)
    book = codebook(values, weights, 32)
    errors = np.abs(values - book[nearest(values, book)])
    assert errors[5000:].max() < 0.5 * errors[:5000].max()


@pytest.mark.parametrize("values", [np.zeros(1000), np.full(1000, 1e30), np.r_[np.zeros(999), 1e37]])
def test_values_without_extent_or_far_apart(values):
    values = values.astype(np.float32)
    book = codebook(values, np.zeros(len(values)), 4)
    assert np.isfinite(book).all()
    assert np.array_equal(book[nearest(values, book)], values)


def test_nearest_is_nearest():
    generator = np.random.default_rng(2)
    book = np.unique(generator.normal(size=50).astype(np.float32))
    values = generator.normal(size=(40, 3)).astype(np.float32)
    found = nearest(values, book)
    assert np.array_equal(found, np.abs(values[..., None].astype(np.float64) - book).argmin(axis=-1))


def test_the_curve_goes_from_each_point_of_a_grid_to_the_next():
    side = 8
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.uint16)
    order = along_curve(grid)
    assert np.array_equal(np.sort(order), np.arange(side**3))
    assert (np.abs(np.diff(grid[order].astype(int), axis=0)).sum(axis=1) == 1).all()


def test_along_the_curve_all_bits_count_and_equal_points_keep_their_order():
    grid = np.array([[65535, 0, 0], [0, 0, 0], [65535, 0, 1], [0, 0, 0], [0, 0, 1]], np.uint16)
    assert along_curve(grid)[:2].tolist() == [1, 3]
    assert along_curve(grid)[2] == 4
