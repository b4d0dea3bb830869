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


def test_the_master_can_be_faster_than_its_workers():
    with pool_of(3) as pool:
        share = shares(pool, 300, 1.5)
    assert [len(each) for each in (share.own, *share.others)] == [129, 86, 85]
