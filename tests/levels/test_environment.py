"""What of a scene is at infinity."""

from __future__ import annotations

import dataclasses

import numpy as np

from potr_cl.levels.environment import Surroundings
from potr_cl.model.camera import camera_centres
from tests.reference.scenes import random_scene, ring_of_cameras

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
