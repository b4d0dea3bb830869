"""The totals' units: no overflow, as fine as that allows, and the same numbers on host and device."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potr_cl.model.camera import Camera
from potr_cl.raster.view_set import TILE
from potr_cl.stages.pruning.sweep import FixedPoint

EYE = Camera("view", 16, 16, 10.0, 10.0, 8.0, 8.0, np.eye(3), np.zeros(3))

SIZES = st.lists(st.tuples(st.integers(1, 5000), st.integers(1, 5000)), min_size=1, max_size=20)


def cameras(sizes) -> list[Camera]:
    return [dataclasses.replace(EYE, width=width, height=height) for width, height in sizes]


def tiles(camera: Camera) -> int:
    return -(-camera.width // TILE) * -(-camera.height // TILE)


@given(SIZES, st.integers(-(2**62), 2**62), st.integers(0, 2**62))
def test_the_largest_sums_fit_and_values_are_totals_in_their_units(sizes, effect, importance):
    """Effects of 16 a pixel and channel are not cut."""
    views = cameras(sizes)
    units = FixedPoint.of_views(views)
    largest = 0.0
    for view in views:
        weight = units.weight(view.width * view.height)
        cut_at, scale = units.bound / weight, units.scale * weight  # as the kernels take them
        largest += tiles(view) * cut_at * scale
    assert largest <= 2.0**62 * (1 + 1e-12)
    assert units.bound == 16 * 3 * TILE * TILE
    assert np.log2(units.scale) % 1 == 0
    effects, importances = units.values(np.array([[effect, importance]], np.int64))
    assert effects[0] == pytest.approx(effect * units.units[0], rel=1e-14)
    assert importances[0] == pytest.approx(importance * units.units[1], rel=1e-14)


@given(SIZES)
def test_no_bit_is_wasted_where_all_views_are_of_a_size(sizes):
    views = cameras([sizes[0]] * len(sizes))
    area = (views[0].width + TILE - 1) * (views[0].height + TILE - 1)
    units = FixedPoint.of_views(views)
    assert 48.0 * area * len(views) * units.scale > 2.0**61


def test_a_pixel_of_any_view_counts_by_its_share_of_the_view():
    """An importance of 1 in every pixel is a mean of 1, whatever the views' sizes."""
    views = cameras([(40, 30), (16, 16), (100, 7)])
    units = FixedPoint.of_views(views)
    total = sum(v.width * v.height * units.scale * units.weight(v.width * v.height) for v in views)
    _, importances = units.values(np.array([[0, int(total)]], np.int64))
    assert importances[0] == pytest.approx(1, rel=1e-12)
