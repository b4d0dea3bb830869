"""How many splats levels of detail have, the views that they are made for, and what of a scene is at infinity."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.levels.environment import Surroundings
from potr_cl.levels.plan import counts_of_levels, scale_of_level, scaled, views_of_level
from potr_cl.levels.seams import SEAM, scales_shown
from potr_cl.model.camera import camera_centres
from potr_cl.opencl.discovery import choose_device
from potr_cl.raster.rasterizer import Rasterizer
from tests.devices import shared_device
from tests.reference.scenes import random_scene, ring_of_cameras


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


VIEWS = ring_of_cameras(8)


def with_sky(splats: int, sky: int, times: float):
    """A scene whose last splats are so many times as far from the middle of the views as its farthest view."""
    scene = random_scene(splats, 1)
    middle = np.median(camera_centres(VIEWS), axis=0)
    spread = np.linalg.norm(camera_centres(VIEWS) - middle, axis=1).max()
    away = np.linalg.norm(scene.means - middle, axis=1)
    assert np.median(away) < spread
    directions = np.random.default_rng(2).normal(size=(sky, 3))
    means = scene.means.copy()
    means[splats - sky :] = middle + times * spread * directions / np.linalg.norm(directions, axis=1)[:, None]
    return dataclasses.replace(scene, means=means)


def test_sky_is_far_and_what_is_looked_at_is_not():
    scene = with_sky(1000, 60, 10.5)
    assert np.flatnonzero(Surroundings.of(scene, VIEWS).have(scene)).tolist() == list(range(940, 1000))
    assert not Surroundings.of(with_sky(1000, 60, 9.5), VIEWS).have(scene).all()
    nearer = with_sky(1000, 60, 9.5)
    assert not Surroundings.of(nearer, VIEWS).have(nearer).any()


def test_another_level_is_cut_at_the_same_distance():
    scene = with_sky(1000, 60, 10.5)
    coarse = scene.subset(np.arange(930, 1000))
    assert np.count_nonzero(Surroundings.of(scene, VIEWS).have(coarse)) == 60


def test_nothing_is_far_where_that_were_much_or_nobody_looks():
    scene = with_sky(1000, 101, 20)
    assert not Surroundings.of(scene, VIEWS).have(scene).any()
    assert not Surroundings.of(scene, []).have(scene).any()


# ---------------------------------- from where a level is shown in place of the finer one


FOUR = ring_of_cameras(4)


@pytest.fixture(scope="module")
def usual_device():
    return shared_device(choose_device().family)


def seam(device, one, other, scale: float) -> float:
    errors = []
    with Rasterizer(device, one) as first, Rasterizer(device, other) as second:
        for view in scaled(FOUR, scale):
            errors.append(np.square(first.render(view)[0].clip(0, 1) - second.render(view)[0].clip(0, 1)).mean())
    return float(np.mean([-10 * np.log10(error) for error in errors]))


def recoloured(scene, seed: int, by: float):
    """Splats of other colours, which average out in small pictures of an antialiased scene."""
    sh = scene.sh.copy()
    sh[:, 0] += np.random.default_rng(seed).normal(0, by, sh[:, 0].shape)
    return dataclasses.replace(scene, sh=sh)


def test_levels_are_shown_from_where_they_are_as_near_as_the_seam(usual_device):
    fine = random_scene(4000, 3).rendered(True)
    fine = dataclasses.replace(fine, log_scales=fine.log_scales - np.float32(2))
    tried = [scale_of_level(1) * 2 ** (-k / 4) for k in range(9)]
    for by in (2, 4, 8, 16, 32, 64):
        worse = recoloured(fine, 4, by)
        seams = np.array([seam(usual_device, fine, worse, scale) for scale in tried])
        if seams[0] < SEAM:
            break
    first = int(np.argmax(seams >= SEAM))
    assert first > 0
    scales = scales_shown(usual_device, [fine, worse].__getitem__, 2, FOUR)
    assert scales == [1, pytest.approx(tried[first])]
    assert scales_shown(usual_device, [fine, fine].__getitem__, 2, FOUR) == [1, scale_of_level(1)]


def test_where_none_is_near_enough_that_of_about_the_nearest_is_taken(usual_device):
    fine = random_scene(2000, 3)
    other = recoloured(fine, 5, 1.0)
    tried = [scale_of_level(1) * 2 ** (-k / 4) for k in range(9)]
    seams = [seam(usual_device, fine, other, scale) for scale in tried]
    assert max(seams) < SEAM
    expected = next(scale for scale, near in zip(tried, seams, strict=True) if near >= max(seams) - 1)
    assert scales_shown(usual_device, [fine, other].__getitem__, 2, FOUR)[1] == pytest.approx(expected)
