"""From where a level is shown in place of the finer one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.levels.plan import scale_of_level, scaled
from potr_cl.levels.seams import SEAM, scales_shown
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from tests.reference.scenes import random_scene, ring_of_cameras

VIEWS = ring_of_cameras(4)


@pytest.fixture(scope="module")
def device():
    return Device()


def seam(device, one, other, scale: float) -> float:
    errors = []
    with Rasterizer(device, one) as first, Rasterizer(device, other) as second:
        for view in scaled(VIEWS, scale):
            errors.append(np.square(first.render(view)[0].clip(0, 1) - second.render(view)[0].clip(0, 1)).mean())
    return float(np.mean([-10 * np.log10(error) for error in errors]))


def recoloured(scene, seed: int, by: float):
    """Splats of other colours, which average out in small pictures of an antialiased scene."""
    sh = scene.sh.copy()
    sh[:, 0] += np.random.default_rng(seed).normal(0, by, sh[:, 0].shape)
    return dataclasses.replace(scene, sh=sh)


def test_levels_are_shown_from_where_they_are_as_near_as_the_seam(device):
    fine = random_scene(4000, 3).rendered(True)
    fine = dataclasses.replace(fine, log_scales=fine.log_scales - np.float32(2))
    tried = [scale_of_level(1) * 2 ** (-k / 4) for k in range(9)]
    for by in (2, 4, 8, 16, 32, 64):
        worse = recoloured(fine, 4, by)
        seams = np.array([seam(device, fine, worse, scale) for scale in tried])
        if seams[0] < SEAM:
            break
    first = int(np.argmax(seams >= SEAM))
    assert first > 0
    scales = scales_shown(device, [fine, worse].__getitem__, 2, VIEWS)
    assert scales == [1, pytest.approx(tried[first])]
    assert scales_shown(device, [fine, fine].__getitem__, 2, VIEWS) == [1, scale_of_level(1)]


def test_where_none_is_near_enough_that_of_about_the_nearest_is_taken(device):
    fine = random_scene(2000, 3)
    other = recoloured(fine, 5, 1.0)
    tried = [scale_of_level(1) * 2 ** (-k / 4) for k in range(9)]
    seams = [seam(device, fine, other, scale) for scale in tried]
    assert max(seams) < SEAM
    expected = next(scale for scale, near in zip(tried, seams, strict=True) if near >= max(seams) - 1)
    assert scales_shown(device, [fine, other].__getitem__, 2, VIEWS)[1] == pytest.approx(expected)
