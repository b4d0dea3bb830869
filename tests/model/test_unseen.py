"""Splats outside of every picture, their groups, and stable orders of many numbers that threads find."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.host.threads import thread_pool
from potr_cl.model import order, splat_groups
from potr_cl.model.order import BITS, ascending, morton_codes, morton_order
from potr_cl.model.splat_groups import SplatGroups, opacity_weighted_areas, unseen_splats
from potr_cl.opencl.discovery import choose_device
from potr_cl.raster.rasterizer import Rasterizer
from tests.devices import shared_device
from tests.reference.scenes import plain_splats, random_splats, ring_of_cameras, straight_camera


def test_what_lies_beside_behind_and_right_in_front_is_unseen():
    camera = straight_camera(60, 60, 60.0, fy=60.0)
    beside = [[4, 0, 5], [-4, 0, 5], [0, 4, 5], [0, -4, 5]]
    places = [[0, 0, 5], [0, 0, -5], [0, 0, 0.1], *beside, [2.4, 0, 5], [0, 0, 1e6]]
    assert unseen_splats(plain_splats(places, 0.01), [camera]).tolist() == [False, *[True] * 6, False, False]
    assert not unseen_splats(plain_splats([[4, 0, 5]], 1.0), [camera])[0], "it reaches into the picture"


@pytest.mark.parametrize("focal", [12.0, 30.0, 100.0])
def test_no_view_draws_what_it_does_not_see(focal):
    """Wide views draw large splats farther beside their pictures than their outlines reach."""
    rng = np.random.default_rng(0)
    camera = dataclasses.replace(straight_camera(48, 32, focal), cx=16.0)
    depths = rng.uniform(0.3, 4, 20000)
    means = np.stack([*(rng.uniform(-5, 5, (2, 20000)) * depths * 24 / focal), depths], axis=1)
    scene = plain_splats(means, np.exp(rng.uniform(-4, 0.5, (20000, 3))), 5.0)
    scene = dataclasses.replace(scene, quaternions=rng.normal(size=(20000, 4)).astype(np.float32))
    unseen = unseen_splats(scene, [camera])
    assert 1000 < np.count_nonzero(unseen) < 19000
    device = shared_device(choose_device().family)
    with Rasterizer(device, scene.subset(unseen)) as rasterizer, rasterizer.prepare_set([camera]) as views:
        assert views.views[0].intersection_count == 0


def test_every_view_counts_and_without_views_all_are_unseen():
    scene = random_splats(300)
    cameras = ring_of_cameras(5, 2.0)
    each = [unseen_splats(scene, [camera]) for camera in cameras]
    assert 0 < np.count_nonzero(each[0]) < 300
    np.testing.assert_array_equal(unseen_splats(scene, cameras), np.logical_and.reduce(each))
    assert unseen_splats(scene, []).all()


@pytest.mark.parametrize("value", [1e30, 3e38])
def test_values_at_the_ends_of_single_precision(value):
    scene = random_splats(20)
    scene = dataclasses.replace(scene, means=np.full_like(scene.means, value))
    assert unseen_splats(scene, ring_of_cameras(3)).shape == (20,)
    huge = dataclasses.replace(scene, log_scales=np.full_like(scene.log_scales, 88))
    assert np.isfinite(opacity_weighted_areas(huge)).all()


def test_shares_of_area():
    scene = plain_splats(np.zeros((3, 3)), [[1.0, 1.0, 0.1], [2.0, 1.0, 0.1], [1.0, 0.1, 0.1]], [0.0, 0.0, 30.0])
    areas = opacity_weighted_areas(scene)
    np.testing.assert_allclose(areas / areas[0], [1, 2, 0.2], rtol=1e-5)


def test_groups_of_neighbours_change_nothing(monkeypatch, plush_excerpt, plush_excerpt_cameras):
    """Large scenes are looked at group by group: the same splats are found."""
    cameras = [dataclasses.replace(c, fx=40 * c.fx, fy=40 * c.fy) for c in plush_excerpt_cameras[:4]]
    wanted = unseen_splats(plush_excerpt, cameras)
    assert 0 < wanted.sum() < len(plush_excerpt)
    monkeypatch.setattr(splat_groups, "_BLOCK", 100)
    with thread_pool(3) as pool:
        groups = SplatGroups.of(plush_excerpt, 16, pool.map)
        assert np.array_equal(unseen_splats(plush_excerpt, cameras, groups, pool.map), wanted)


def test_threads_make_the_same_groups(monkeypatch, plush_excerpt):
    wanted = SplatGroups.of(plush_excerpt, 16)
    monkeypatch.setattr(order, "_ROWS", 1000)
    monkeypatch.setattr(splat_groups, "_GROUPS", 7)
    with thread_pool(3) as pool:
        found = SplatGroups.of(plush_excerpt, 16, pool.map)
    for name in ("order", "starts", "centres", "halves", "sizes"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name)), name
    for group in range(len(found.starts) - 1):
        own = found.order[found.starts[group] : found.starts[group + 1]]
        assert np.array_equal(np.flatnonzero(found.group_of == group), np.sort(own))


@pytest.fixture
def _small_ranges(monkeypatch):
    """So that a few thousand numbers are many."""
    monkeypatch.setattr(order, "_LARGE", 1000)
    monkeypatch.setattr(order, "_RANGE", 128)
    monkeypatch.setattr(order, "_DEALT", 700)
    monkeypatch.setattr(order, "_ROWS", 300)


@pytest.mark.usefixtures("_small_ranges")
@pytest.mark.parametrize("kind", ["all equal", "few values", "large", "sorted", "normal"])
@pytest.mark.parametrize("count", [0, 999, 1000, 5021])
def test_it_is_the_stable_order(kind, count):
    rng = np.random.default_rng(3)
    score = {
        "all equal": np.full(count, 7, np.uint64),
        "few values": rng.integers(0, 5, count).astype(np.uint64),
        "large": rng.integers(0, 1 << 64, count, dtype=np.uint64),
        "sorted": np.arange(count, dtype=np.uint64),
        "normal": rng.normal(size=count),
    }[kind]
    wanted = np.argsort(score, kind="stable")
    assert np.array_equal(ascending(score), wanted)
    with thread_pool(3) as pool:
        assert np.array_equal(ascending(score, pool.map), wanted)


@pytest.mark.usefixtures("_small_ranges")
def test_morton_codes_have_the_bits_of_three_coordinates_in_turn():
    rng = np.random.default_rng(4)
    means = rng.normal(size=(2000, 3)).astype(np.float32)
    means[5], means[6] = 1e30, -1e30
    codes = morton_codes(means)
    low, high = np.percentile(means.astype(np.float64), (2, 98), axis=0)
    side = 2 * (high - low).max()
    cells = (means - ((low + high) / 2 - side / 2)) * ((1 << BITS) / side)
    cells = np.clip(cells, 0, (1 << BITS) - 1).astype(np.uint64)
    bits = [cells[:, axis] >> np.uint64(bit) & np.uint64(1) for bit in range(BITS) for axis in range(3)]
    assert np.array_equal(codes, sum(bit << np.uint64(at) for at, bit in enumerate(bits)))
    assert np.array_equal(morton_order(means), np.argsort(codes, kind="stable"))
