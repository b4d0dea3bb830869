"""Removal effects as a function: what a splat's removal really does to the pictures."""

from __future__ import annotations

import numpy as np
import pytest

import potr_cl
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer


@pytest.fixture(scope="module")
def effects(plush_excerpt, plush_excerpt_cameras):
    return potr_cl.removal_effects(plush_excerpt, plush_excerpt_cameras)


def test_effects_are_what_a_removal_does(plush_excerpt, plush_excerpt_cameras, effects):
    device, views = Device(), train_views(plush_excerpt_cameras)

    def pictures(scene):
        with Rasterizer(device, scene) as rasterizer:
            return np.stack([rasterizer.render(view)[0] for view in views]).astype(np.float64)

    whole, order = pictures(plush_excerpt), np.argsort(effects.delta_mse)
    for splat in order[[-1, -20, -200]]:
        left = np.arange(len(plush_excerpt)) != splat
        mse = float(np.mean((pictures(plush_excerpt[left]) - whole) ** 2))
        assert effects.delta_mse[splat] == pytest.approx(mse, rel=1e-2)
    assert effects.views == [view.name for view in views]
    assert effects.delta_mse.shape == effects.importance.shape == (len(plush_excerpt),)
    assert (effects.importance >= 0).all()


def test_views_add_up_to_the_same_bits(plush_excerpt, plush_excerpt_cameras, effects):
    by_view = potr_cl.removal_effects(plush_excerpt, plush_excerpt_cameras, by_view=True)
    assert effects.delta_mse_by_view is None
    assert by_view.delta_mse_by_view.shape == (len(effects.views), len(plush_excerpt))
    assert np.array_equal(by_view.delta_mse, effects.delta_mse)
    assert np.array_equal(by_view.importance, effects.importance)
    np.testing.assert_allclose(by_view.delta_mse_by_view.sum(axis=0), effects.delta_mse, rtol=1e-12)
    np.testing.assert_allclose(by_view.importance_by_view.sum(axis=0), effects.importance, rtol=1e-12)
