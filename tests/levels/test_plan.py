"""How many splats levels of detail have, and the views that they are made for."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.levels.plan import counts_of_levels, views_of_level
from tests.reference.scenes import ring_of_cameras


@pytest.mark.parametrize(
    ("splats", "levels", "counts"),
    [
        (120_000, "auto", [120_000, 60_000, 30_000, 15_000]),
        (29_999, "auto", [29_999]),
        (10_000_000, "auto", [10_000_000, 5_000_000, 2_500_000, 1_250_000, 625_000, 312_500]),
        (1000, 3, [1000, 500, 250]),
        (3, 12, [3, 2, 1]),
        (1000, 1, [1000]),
    ],
)
def test_splats_are_halved_from_level_to_level(splats, levels, counts):
    assert counts_of_levels(splats, levels) == counts


def test_a_level_with_a_quarter_of_the_splats_is_seen_in_a_quarter_of_the_pixels():
    views = ring_of_cameras(3)
    assert views_of_level(views, 0) == views
    for before, after in zip(views, views_of_level(views, 2), strict=True):
        assert (2 * after.width, 2 * after.height) == (before.width, before.height)
        assert np.allclose((2 * after.fx, 2 * after.cy), (before.fx, before.cy))
        assert np.array_equal(after.rotation, before.rotation)
