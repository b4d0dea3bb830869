"""Long lists of tiles, sorted by many work-groups: the same order."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.raster import launcher, preparing_memory
from potr_cl.raster.rasterizer import Rasterizer
from tests.reference.scenes import ring_of_cameras, visible_scene


def lists_of(gpu, scene, cameras):
    with Rasterizer(gpu, scene) as rasterizer, rasterizer.prepare_set(cameras) as views:
        return gpu.download(views.intersections, (views.capacity,), np.uint32), views.found_offsets


@pytest.mark.parametrize(("count", "longest"), [(2500, 16), (2500, 700), (9000, 700), (9000, 2048)])
def test_the_same_order(gpu, monkeypatch, count, longest):
    """Of lists of any length: shorter than a piece, some pieces, and some that stay as they were."""
    scene = visible_scene(count, 0)
    scene = dataclasses.replace(scene, log_scales=scene.log_scales - 1)
    cameras = ring_of_cameras(3, size=40)
    wanted, offsets = lists_of(gpu, scene, cameras)
    lengths = np.concatenate([np.diff(each.astype(np.int64)) for each in offsets])
    assert lengths.max() > longest
    sorted_apart = []

    class Noting(preparing_memory.LongLists):
        def enqueue(self, *args: object) -> None:
            sorted_apart.append(self)
            super().enqueue(*args)  # type: ignore[arg-type]

    monkeypatch.setattr("potr_cl.raster.preparing_memory.LongLists", Noting)
    monkeypatch.setattr(preparing_memory, "LONGEST", longest)
    monkeypatch.setattr(launcher, "LONGEST", longest)
    got, _ = lists_of(gpu, scene, cameras)
    assert sorted_apart
    assert np.array_equal(got, wanted)
    monkeypatch.setattr(preparing_memory, "PIECE", 64)
    got, _ = lists_of(gpu, scene, cameras)
    assert np.array_equal(got, wanted)


def test_without_room_the_same_order(gpu, monkeypatch):
    """Long lists are sorted as others are then: a view that the device has room for is prepared."""
    scene, cameras = visible_scene(2500, 0), ring_of_cameras(3, size=40)
    wanted, _ = lists_of(gpu, scene, cameras)

    class WithoutRoom(preparing_memory.LongLists):
        def find(self, views: object) -> bool:
            with monkeypatch.context() as full:
                full.setattr(gpu, "info", dataclasses.replace(gpu.info, memory=gpu.allocated))
                found = super().find(views)  # type: ignore[arg-type]
            asked.append(found)
            return found

    asked: list[bool] = []
    monkeypatch.setattr("potr_cl.raster.preparing_memory.LongLists", WithoutRoom)
    monkeypatch.setattr(preparing_memory, "LONGEST", 16)
    monkeypatch.setattr(launcher, "LONGEST", 16)
    got, _ = lists_of(gpu, scene, cameras)
    assert asked == [False]
    assert np.array_equal(got, wanted)


def test_lists_as_others(gpu, monkeypatch):
    """None is long: nothing is sorted apart."""
    monkeypatch.setattr(preparing_memory.LongLists, "enqueue", lambda *args: pytest.fail("there is no long list"))
    lists_of(gpu, visible_scene(500, 0), ring_of_cameras(2, size=40))
