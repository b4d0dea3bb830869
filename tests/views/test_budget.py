"""Which groups of a plan stay on the device, and which are streamed together. No device is asked."""

from __future__ import annotations

import numpy as np

from potr_cl.views.budget import ClusterBudget, KnownBudget, NamedBudget, target_bytes
from potr_cl.views.plan import neighbours
from potr_cl.views.visibility import ViewGroup
from tests.reference.scenes import ring_of_cameras

CAMERAS = ring_of_cameras(12, size=32)
PICTURE = target_bytes(CAMERAS[0])


def singles(count=1000):
    """A group for each view, its cells those of its neighbours."""
    return [
        ViewGroup((number,), count, np.isin(np.arange(12), (number, (number + 1) % 12))) for number in range(12)
    ]  # fmt: skip


def test_pictures_of_all_views_have_room_before_any_view_stays():
    groups = singles()
    budget = NamedBudget(12 * PICTURE + 50_000, groups, CAMERAS, totals=0)
    assert budget.room(groups[0]) < PICTURE
    budget.took(groups[0], 0)
    streamed = groups[1:]
    for group in streamed:
        budget.room(group)
        budget.took(group, 0)
    assert budget.of_pictures(groups) <= 12 * PICTURE + 50_000
    assert budget.of_pictures(groups) >= 11 * PICTURE - budget.streamed


def test_where_all_views_fit_nothing_is_set_aside():
    groups = singles()
    budget = NamedBudget(1 << 30, groups, CAMERAS, totals=1 << 20)
    for group in groups:
        room = budget.room(group)
        budget.took(group, 100_000)
        assert room > (1 << 30) - 12 * 100_000 - 1
    assert budget.of_pictures([]) == (1 << 30) - 12 * 100_000


def test_views_that_are_known_to_take_too_much_are_not_tried():
    wide, narrow = (ViewGroup((number,), 10, nbytes=nbytes) for number, nbytes in ((0, 900), (1, 500)))
    budget = KnownBudget(4000)
    assert budget.room(wide) < 0  # to make it takes more than that
    few = [ViewGroup((number,), 1, nbytes=900) for number in range(4)]
    kept = []
    for group in few:
        if budget.room(group) >= 0:
            budget.took(group, 1)
            kept.append(group)
    assert len(kept) == 3
    assert budget.room(narrow) < 0


def test_clusters_share_what_is_left_by_their_work():
    groups = [ViewGroup((0, 1, 2), 100), ViewGroup((3,), 100)]
    budget = ClusterBudget(80_000, groups, splat=100)
    assert not budget.scenes_rest
    first = budget.room(groups[0])
    budget.took(groups[0], int(first))
    last = budget.room(groups[1])
    assert first > 2.5 * last > 0
    assert first + last < 80_000 - 200 * 100
    assert ClusterBudget(30_000, groups, splat=100).scenes_rest


def test_neighbours_are_streamed_together_as_far_as_they_may():
    counts = np.full(12, 500, np.int64)
    together = neighbours(singles(), counts, CAMERAS, passing=1 << 30)
    assert [number for group in together for number in group.numbers] == list(range(12))
    assert 1 < len(together) < 12
    for group in together:
        assert group.count == 500 * int(group.cells.sum())
    assert len(neighbours(singles(), counts, CAMERAS, passing=0)) == 12
