"""What is kept of views where memory is short: lists first, then what others ask for, then projections."""

from __future__ import annotations

import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.views.budget import ViewCache

pytestmark = pytest.mark.one_runtime


@pytest.mark.parametrize(
    ("geometries", "others", "whole"),
    [(8.5, 0, 7), (4.5, 0, 3), (4.5, 2, 1), (4.5, 20, 0), (1, 20, 0)],
    ids=["all", "no others", "some room for others", "much for others", "lists alone"],
)
def test_lists_come_first_and_projections_last(device, plush_excerpt, plush_excerpt_cameras, geometries, others, whole):
    with Rasterizer(device, plush_excerpt) as rasterizer:
        sets = [rasterizer.prepare_set([camera]) for camera in plush_excerpt_cameras[:7]]
        one, lists = 48 * rasterizer.stride, sum(views.nbytes_cached for views in sets)
        with ViewCache(device, lists + geometries * one, others * one) as cache:
            assert all([cache.keep(views) for views in sets])
            assert sum(views.shapes is not None for views in sets) == whole
            shared = int(cache.shared is not None)
            assert cache.room == pytest.approx((geometries - whole - shared) * one)
            for views in sets:
                views.close()


def test_a_device_that_refuses_what_views_share_takes_no_room(
    device, plush_excerpt, plush_excerpt_cameras, monkeypatch
):
    with Rasterizer(device, plush_excerpt) as rasterizer, rasterizer.prepare_set(plush_excerpt_cameras[:1]) as views:
        room = views.nbytes_cached + 48 * rasterizer.stride
        with ViewCache(device, room, others=1e12) as cache:

            def refused(nbytes, what):
                raise DeviceMemoryError("full")

            with monkeypatch.context() as refusing:
                refusing.setattr(device, "allocate", refused)
                with pytest.raises(DeviceMemoryError):
                    cache.keep(views)
            assert cache.room == room
            assert cache.keep(views)
