"""How views are shared out."""

from __future__ import annotations

import pytest

from potr_cl.workers.dealing import deal


@pytest.mark.parametrize(("views", "workers"), [(9, 1), (9, 2), (10, 3), (2, 5), (0, 2)])
def test_each_view_goes_to_one_worker(views, workers):
    shares = deal(views, [1.0] * workers)
    assert sorted(view for share in shares for view in share) == list(range(views))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert all(share == sorted(share) for share in shares)


def test_fast_workers_get_more():
    shares = deal(90, [1.0, 2.0, 6.0])
    assert [len(share) for share in shares] == [10, 20, 60]
