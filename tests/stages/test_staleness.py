"""Which tiles are swept again: by tolerance, in turns, and as lists of the sets."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.stages.pruning.resident import TileSchedule, by_set
from potr_cl.stages.pruning.sweep import SweepOptions

#: Two views of 3 and 2 tiles among others that are not cached.
VIEWS = [(1, 3), (4, 2)]
NEVER_SWEPT = np.full(5, np.inf, np.float32)


def staleness(*values: float):
    return np.array(values, np.float32)


def test_tiles_staler_than_the_tolerance():
    schedule = TileSchedule(SweepOptions(0.1), VIEWS)
    assert schedule.choose(3, staleness(0, 0.1, 0.2, 0.05, np.inf)).tolist() == [2, 4]


def test_the_first_measurement_takes_all_tiles_whatever_is_traded():
    schedule = TileSchedule(SweepOptions(0.1, turns=3), VIEWS)
    assert schedule.choose(0, NEVER_SWEPT).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("tolerance", "again"), [(-1.0, True), (0.0, False), (0.1, False)])
def test_swept_tiles_are_fresh_but_for_a_negative_tolerance(tolerance, again):
    schedule = TileSchedule(SweepOptions(tolerance), VIEWS)
    stale = NEVER_SWEPT.copy()
    schedule.note_swept(stale, np.array([0, 3]))
    chosen = schedule.choose(1, stale).tolist()
    assert chosen == ([0, 1, 2, 3, 4] if again else [1, 2, 4])


def test_changed_tiles_are_those_that_lost_anything():
    schedule = TileSchedule(SweepOptions(0.5, turns=7), VIEWS)
    assert schedule.changed(staleness(0, 1e-30, 0.2, np.inf, 0)).tolist() == [1, 2, 3]


@given(
    st.integers(1, 6),
    st.lists(st.tuples(st.integers(0, 20), st.integers(1, 5)), min_size=1, max_size=8, unique_by=lambda view: view[0]),
    st.integers(1, 50),
)
def test_each_view_has_its_turn_once_in_every_round(turns, views, measurement):
    schedule = TileSchedule(SweepOptions(0, turns=turns), views)
    stale = np.ones(sum(tiles for _, tiles in views), np.float32)
    chosen = [schedule.choose(measurement + i, stale) for i in range(turns)]
    assert np.sort(np.concatenate(chosen)).tolist() == list(range(len(stale)))
    starts = np.cumsum([0] + [tiles for _, tiles in views])
    for tiles in chosen:  # whole views
        for start, stop in itertools.pairwise(starts):
            assert np.isin(np.arange(start, stop), tiles).sum() in (0, stop - start)


@given(st.lists(st.integers(1, 9), max_size=6), st.data())
def test_lists_of_the_sets_name_the_same_tiles(sizes, data):
    starts = np.cumsum([0, *sizes])
    wanted = data.draw(hnp.arrays(bool, int(starts[-1])))
    listed, counts = by_set(np.flatnonzero(wanted), starts.tolist())
    found = np.zeros_like(wanted)
    for first, size, count in zip(starts[:-1], sizes, counts, strict=True):
        tiles = listed[first : first + count].astype(np.int64)
        assert ((tiles >= 0) & (tiles < size)).all()
        assert (np.diff(tiles) > 0).all()
        found[first + tiles] = True
    assert np.array_equal(found, wanted)
    assert sum(counts) == np.count_nonzero(wanted)


def test_without_resident_views_there_is_nothing_to_sweep():
    schedule = TileSchedule(SweepOptions(0, turns=2), [])
    assert len(schedule.choose(1, np.zeros(0, np.float32))) == 0
    assert by_set(np.zeros(0, np.int64), [0])[1] == []
