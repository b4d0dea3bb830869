"""How views are shared out."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from potr_cl.workers.host import HostPool
from potr_cl.workers.pool import deal, shares


def pool_of(devices):
    return HostPool([SimpleNamespace(family="gpu", info="alike") for _ in range(devices)])


@pytest.mark.parametrize(("views", "workers"), [(9, 1), (9, 2), (10, 3), (2, 5), (0, 2)])
def test_each_view_goes_to_one_worker(views, workers):
    shares = deal(views, [1.0] * workers)
    assert sorted(view for share in shares for view in share) == list(range(views))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert all(share == sorted(share) for share in shares)


def test_fast_workers_get_more():
    shares = deal(90, [1.0, 2.0, 6.0])
    assert [len(share) for share in shares] == [10, 20, 60]


@pytest.mark.parametrize(("devices", "views"), [(2, 200), (2, 7), (3, 100), (4, 2)])
def test_parts_of_the_views_are_shared_out_too(devices, views):
    """Work on every second view is work for all devices, not for those that have the even ones."""
    with pool_of(devices) as pool:
        share = shares(pool, views, 2)
    dealt = [share.own, *share.others]
    assert sorted(view for each in dealt for view in each) == list(range(views))
    assert all(each == sorted(each) for each in dealt)
    for part in (range(0, views, 2), range(1, views, 2)):
        counts = [len(set(part) & set(each)) for each in dealt]
        assert max(counts) - min(counts) <= 1
    assert max(map(len, dealt)) - min(map(len, dealt)) <= 1


def test_the_master_can_be_faster_than_its_workers():
    with pool_of(3) as pool:
        share = shares(pool, 300, 2, 1.5)
    assert [len(each) for each in (share.own, *share.others)] == [128, 86, 86]
