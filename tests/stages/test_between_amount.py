"""How many views a scene is found to need: bounds that do not depend on the constants."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.stages.views_between import most_needed, needed, views_where_few


@pytest.mark.parametrize("slow", [False, True])
def test_the_fewer_views_show_it_the_more_are_added(slow):
    amounts = [needed(shown, 100, slow) for shown in (100, 50, 25, 12, 6, 3, 1)]
    assert amounts == sorted(amounts)
    assert amounts[0] == 0
    assert amounts[-1] == most_needed(100, slow, few=not slow) > 0


def test_what_few_views_show_counts_however_many_show_the_rest():
    assert views_where_few(np.repeat([5, 80], [40, 60])) == 5
    # But not a few splats behind the cameras.
    assert views_where_few(np.repeat([1, 80], [10, 90])) == 80


@pytest.mark.parametrize("views", [2, 8, 20, 84, 300, 2000])
def test_they_take_no_more_than_their_share_of_the_time(views):
    """As measured: on a GPU an encode takes as long as some 130 views besides its views, on a CPU as some 6."""
    for slow, besides in ((False, 130), (True, 6)):
        for shown_by, most in ((10, 1.6), (1, 1.6 if slow else 2.2)):
            added = views * needed(shown_by, views, slow)
            assert added > 0
            assert (besides + views + added) / (besides + views) < most


def test_where_few_views_show_a_part_a_gpu_takes_more_time():
    assert needed(9, 300, slow=False) > 1.5 * needed(10, 300, slow=False)
    assert needed(9, 300, slow=True) == needed(10, 300, slow=True)
