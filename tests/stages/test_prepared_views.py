"""Which views stay prepared within a budget, and in sets of how many."""

from __future__ import annotations

import dataclasses

import pytest

from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.launcher import launcher_for
from potr_cl.stages.pruning.prepared_views import PreparedViews
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tests.devices import FAMILIES, open_device

PLENTY = 1 << 40


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "prepared views did not give all their memory back"


@pytest.fixture
def rasterizer(device, plush_excerpt):
    with Rasterizer(device, plush_excerpt) as rasterizer:
        yield rasterizer


@pytest.fixture
def cameras(plush_excerpt_cameras):
    return plush_excerpt_cameras[:7]


def prepare(rasterizer, cameras, budget, progress=None) -> PreparedViews:
    launcher = launcher_for(rasterizer, SweepOptions(), FixedPoint.of_views(cameras))
    return PreparedViews(rasterizer, cameras, budget, launcher.most_views, progress)


def test_all_views_are_cached_where_there_is_room(device, rasterizer, cameras):
    progress = []
    with prepare(rasterizer, cameras, PLENTY, lambda done, count: progress.append((done, count))) as prepared:
        numbers = [number for views in prepared.cached for number in views.numbers]
        sizes = [tiles for _, tiles in prepared.cached_view_tiles]
        assert numbers == [number for number, _ in prepared.cached_view_tiles] == list(range(7))
        assert sum(sizes) == prepared.cached_tiles == prepared.tiles
        first_tiles = [views.first_tile for views in prepared.cached]
        assert first_tiles == [sum(sizes[: views.numbers.start]) for views in prepared.cached]
        assert prepared.uncached == []
        assert not prepared.geometry_is_shared
        assert len(prepared.cached) == (7 if device.family == "cpu" else 1)
    assert progress[-1] == (7, 7)


def test_buffers_too_small_for_all_views_make_smaller_sets(device, rasterizer, cameras, monkeypatch):
    largest = 3 * 12 * cameras[0].width * cameras[0].height
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, largest_buffer=largest))
    with prepare(rasterizer, cameras, PLENTY) as prepared:
        sets = [list(views.numbers) for views in prepared.cached]
    one_each = [[number] for number in range(7)]
    assert sets == (one_each if device.family == "cpu" else [[0, 1], [2, 3], [4, 5], [6]])


def test_nothing_is_cached_without_a_budget(device, rasterizer, cameras):
    before = device.allocated
    with prepare(rasterizer, cameras, 0) as prepared:
        assert prepared.cached == []
        assert [number for numbers in prepared.uncached for number in numbers] == list(range(7))
        assert prepared.cached_tiles == 0 < prepared.tiles
        scratch = device.allocated - before
        with prepared.prepare(prepared.uncached[0]):
            assert device.allocated > before + scratch
        assert device.allocated <= before + scratch


def test_first_lists_are_kept_then_geometry(rasterizer, cameras):
    """Less memory than all need: the lists stay, and projections share what room there is."""
    with prepare(rasterizer, cameras, PLENTY) as prepared:
        lists = sum(views.views.nbytes_cached + views.nbytes for views in prepared.cached)
    one_view = 48 * rasterizer.stride
    with prepare(rasterizer, cameras, lists + 3.5 * one_view) as prepared:
        own = [views for views in prepared.cached if views.views.shapes is not None]
        shared = [views for views in prepared.cached if views.views.shapes is None]
        assert prepared.uncached == []
        assert prepared.geometry_is_shared
        assert len(shared) > 0
        assert len({id(prepared.geometry(views)[0]) for views in shared}) == 1
        assert all(prepared.geometry(views) == (views.views.shapes, views.views.colours) for views in own)
