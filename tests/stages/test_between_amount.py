"""How many views a scene is found to need: bounds that do not depend on the constants."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.stages.between.amount import most_needed, needed


def parts(views: int) -> np.ndarray:
    """A scene of which each part is shown by so many views."""
    return np.full(100, views)


@pytest.mark.parametrize("slow", [False, True])
def test_the_fewer_views_show_it_the_more_are_added(slow):
    amounts = [needed(parts(shown), 100, slow) for shown in (100, 50, 25, 12, 6, 3, 1)]
    assert amounts == sorted(amounts)
    assert amounts[0] == 0
    assert amounts[-1] == most_needed(100, slow) > 0


def test_what_few_views_show_counts_however_many_show_the_rest():
    split = np.concatenate([parts(5)[:40], parts(80)[:60]])
    assert needed(split, 100, False) == needed(parts(5), 100, False)
    # But not a few splats behind the cameras.
    assert needed(np.concatenate([parts(1)[:10], parts(80)[:90]]), 100, False) == 0


@pytest.mark.parametrize("views", [2, 8, 20, 84, 300, 2000])
def test_they_take_no_more_than_their_share_of_the_time(views):
    """As measured: on a GPU an encode takes as long as some 130 views besides its views, on a CPU as some 4."""
    for slow, besides in ((False, 130), (True, 4)):
        added = views * needed(parts(1), views, slow)
        assert added > 0
        assert (besides + views + added) / (besides + views) < 1.6


def test_views_that_show_nothing_need_no_others():
    assert needed(np.zeros(0, np.int64), 40, False) == 0
