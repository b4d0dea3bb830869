"""Groups of splats that are left out for a view: never one of which the kernels draw a splat."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model import splat_groups
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import SplatGroups
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT, INRIA, RasterRules
from potr_cl.views import visibility
from potr_cl.views.visibility import Visibility, seen_part
from tests.devices import FAMILIES, shared_device
from tests.reference.captures import looking
from tests.reference.scenes import random_scene


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = shared_device(request.param)
    yield device
    assert device.allocated == 0, "not all memory was given back"


def drawn(device, scene: Scene, cameras: list[Camera], rules: RasterRules) -> list[np.ndarray]:
    """The splats in each view's tile lists, by brute force: all are projected."""
    found = []
    with Rasterizer(device, scene, rules) as rasterizer:
        for camera in cameras:
            with rasterizer.prepare_set([camera]) as views:
                count = views.views[0].intersection_count
                found.append(np.unique(device.download(views.intersections, (count,), np.uint32)) if count else [])
    return [np.asarray(each, np.int64) for each in found]


def wide_and_narrow(scene: Scene, count: int, seed: int, fields=(0.05, 0.4, 1.0, 2.5)) -> list[Camera]:
    """Views from in and around a scene, of all fields."""
    rng = np.random.default_rng(seed)
    low, high = np.percentile(scene.means, (5, 95), axis=0)
    cameras = []
    for number in range(count):
        here, there = rng.uniform(low - (high - low), high + (high - low)), rng.uniform(low, high)
        camera = looking(here, there, name=f"{number}", wide=float(rng.choice(fields)))
        cameras.append(dataclasses.replace(camera, cx=float(rng.uniform(100, 500))))
    return cameras


def clusters(seed: int, splats: int = 12_000) -> Scene:
    """Heaps of splats, thin and long ones, and some as large as everything."""
    rng = np.random.default_rng(seed)
    scene = random_scene(splats, 0, seed=seed)
    centres = rng.uniform(-40, 40, (25, 3))
    means = centres[rng.integers(0, 25, splats)] + rng.normal(size=(splats, 3)) * 0.7
    log_scales = rng.normal(-3.5, 1.0, (splats, 3))
    log_scales[rng.random(splats) < 0.002] += 5
    return dataclasses.replace(scene, means=means.astype(np.float32), log_scales=log_scales.astype(np.float32))


@pytest.mark.parametrize(
    ("rules", "antialiased"),
    [pytest.param(INRIA, False, id="inria"), pytest.param(GSPLAT, True, id="gsplat, antialiased")],
)
def test_nothing_that_is_drawn_is_left_out(device, rules, antialiased):
    scene = clusters(1).rendered(antialiased)
    groups = SplatGroups.of(scene, 64)
    cameras = wide_and_narrow(scene, 16, 2)
    left_out = not_drawn = 0
    for camera, splats in zip(cameras, drawn(device, scene, cameras, rules), strict=True):
        kept = np.zeros(len(scene), bool)
        kept[groups.splats(groups.visible(camera, rules.near))] = True
        assert kept[splats].all()
        left_out += int((~kept).sum())
        not_drawn += len(scene) - len(splats)
    assert left_out > 0.3 * not_drawn


def test_far_from_the_origin(device):
    """Where single precision tells centres apart by a hundredth of a unit."""
    scene = clusters(3)
    scene = dataclasses.replace(scene, means=(scene.means + np.float32(1e5)).astype(np.float32))
    groups = SplatGroups.of(scene, 64)
    cameras = wide_and_narrow(scene, 6, 4)
    for camera, splats in zip(cameras, drawn(device, scene, cameras, INRIA), strict=True):
        assert np.isin(splats, groups.splats(groups.visible(camera, INRIA.near))).all()


@pytest.mark.slow
def test_a_real_scene(device, plush_excerpt, plush_excerpt_cameras):
    groups = SplatGroups.of(plush_excerpt, 16)
    close = [dataclasses.replace(c, fx=4 * c.fx, fy=4 * c.fy) for c in plush_excerpt_cameras]
    cameras = [*plush_excerpt_cameras, *close, *wide_and_narrow(plush_excerpt, 20, 5)]
    for camera, splats in zip(cameras, drawn(device, plush_excerpt, cameras, INRIA), strict=True):
        assert np.isin(splats, groups.splats(groups.visible(camera, INRIA.near))).all()


def test_every_splat_is_in_one_group():
    scene = clusters(5, 5000)
    groups = SplatGroups.of(scene, 100)
    assert np.array_equal(np.sort(groups.order), np.arange(5000))
    everything = np.ones(len(groups.counts), bool)
    assert np.array_equal(groups.splats(everything), np.arange(5000))
    assert groups.counts.max() == 100
    one = SplatGroups.of(scene.subset(np.arange(1)))
    assert one.counts.tolist() == [1]


def test_parts_have_all_views_and_what_they_see(monkeypatch):
    scene = clusters(6)
    monkeypatch.setattr(splat_groups, "LARGEST", 64)
    cameras = wide_and_narrow(scene, 40, 7, (0.05, 0.1))
    groups = SplatGroups.of(scene)
    parts = Visibility.of(scene, cameras).clusters()
    assert sorted(number for part in parts for number in part.numbers) == list(range(40))
    for part in parts:
        assert list(part.numbers) == sorted(part.numbers)
        assert (np.diff(part.splats) > 0).all()
        for number in part.numbers:
            assert np.isin(groups.splats(groups.visible(cameras[number], INRIA.near)), part.splats).all()
    assert len(parts) > 1
    assert sum(len(part.numbers) * len(part.splats) for part in parts) < len(scene) * len(cameras)


def test_what_views_see_is_told_from_few_splats(monkeypatch):
    """About as much as they do; and nothing is left out where no view says so."""
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    scene = clusters(6, 30_000)
    cameras = wide_and_narrow(scene, 12, 7, (0.05, 1.0))
    groups = SplatGroups.of(scene, 1)
    seen = groups.visible_by(cameras, INRIA.near).mean()
    assert seen_part(scene, cameras, INRIA.near) == pytest.approx(seen, rel=0.3)
    assert seen_part(scene, [], INRIA.near) == 1
