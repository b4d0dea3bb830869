"""What pruning keeps account of: states of splats, tiles that are stale, units of the totals."""

from __future__ import annotations

import dataclasses
import itertools
import re
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.source import kernel_source
from potr_cl.raster.view_set import TILE
from potr_cl.stages.pruning.buffers import SplatState, Survivors
from potr_cl.stages.pruning.resident import Queues, TileSchedule, by_set
from potr_cl.stages.pruning.sweep import FixedPoint, SweepOptions

REMOVED, ALIVE, JUST_REMOVED = SplatState


def test_the_kernels_know_the_same_states():
    defined = re.findall(r"^#define SPLAT_(\w+) (\d+)$", kernel_source("prune/removal.clh"), re.MULTILINE)
    assert {name: int(value) for name, value in defined} == {state.name: int(state) for state in SplatState}


@pytest.fixture
def waits():
    return []


@pytest.fixture
def survivors(usual_device, waits):
    with Survivors(usual_device, 5, 8, lambda: waits.append(on_device(usual_device, made))) as made:
        yield made


def on_device(device, survivors) -> list[int]:
    return device.download(survivors.buffer, (8,), np.uint8).tolist()


def test_a_removal_is_settled_once_the_kernels_that_look_for_it_are_done(usual_device, survivors, waits):
    assert survivors.alive.tolist() == [True] * 5
    assert on_device(usual_device, survivors) == [ALIVE] * 8
    survivors.mark(np.array([0b01010], np.uint8))
    survivors.are_marked()
    just = [ALIVE, JUST_REMOVED, ALIVE, JUST_REMOVED, *[ALIVE] * 4]
    assert on_device(usual_device, survivors) == just
    assert waits == []
    assert survivors.alive.tolist() == [True, False, True, False, True]
    assert waits == [just]  # before the states changed
    assert on_device(usual_device, survivors) == [ALIVE, REMOVED, ALIVE, REMOVED, *[ALIVE] * 4]
    survivors.settle()
    assert len(waits) == 1


def test_what_the_device_has_marked_reaches_the_host(usual_device, survivors):
    marked = np.array([ALIVE, ALIVE, JUST_REMOVED, REMOVED, *[ALIVE] * 4], np.uint8)
    cl.enqueue_copy(usual_device.queue, survivors.buffer, marked, is_blocking=True)
    survivors.are_marked()
    assert survivors.alive.tolist() == [True, True, False, False, True]
    assert on_device(usual_device, survivors) == [ALIVE, ALIVE, REMOVED, REMOVED, *[ALIVE] * 4]


def test_removals_add_up(survivors):
    """Settled in between or not."""
    for splats, settled in ((0b1, True), (0b10, False), (0b10000, False)):
        survivors.mark(np.array([splats], np.uint8))
        survivors.are_marked()
        if settled:
            survivors.settle()
    assert survivors.alive.tolist() == [False, False, True, True, False]


def test_marks_travel_as_bits(usual_device, survivors):
    """Another device that is told the bits has the same states as the one whose controller marked the splats."""
    with Survivors(usual_device, 5, 8, lambda: None) as told:
        for marks in (
            [ALIVE, JUST_REMOVED, ALIVE, ALIVE, JUST_REMOVED],
            [JUST_REMOVED, REMOVED, ALIVE, ALIVE, REMOVED],
        ):
            states = np.array([*marks, *[ALIVE] * 3], np.uint8)
            cl.enqueue_copy(usual_device.queue, survivors.buffer, states, is_blocking=True)
            survivors.are_marked()
            told.mark(survivors.just_marked())
            told.are_marked()
            assert on_device(usual_device, told) == states.tolist()
        assert told.alive.tolist() == survivors.alive.tolist() == [False, False, True, True, False]


def refusing(*_args, **_more):
    raise cl.RuntimeError("clEnqueueWriteBuffer failed: INVALID_MEM_OBJECT")


def test_what_the_driver_refuses_is_told_in_one_line(survivors, monkeypatch):
    survivors.are_marked()
    monkeypatch.setattr(cl, "enqueue_copy", refusing)
    with pytest.raises(DeviceError, match="INVALID_MEM_OBJECT"):
        survivors.settle()
    monkeypatch.undo()


@pytest.mark.parametrize("refused", ["finish", "flush"])
@pytest.mark.parametrize("most", [1, 2])
def test_so_is_what_queues_refuse(usual_device, refused, most, monkeypatch):
    """But one queue is not waited for."""
    queue = SimpleNamespace(finish=lambda: None, flush=lambda: None, properties=0)
    setattr(queue, refused, refusing)
    monkeypatch.setattr(cl, "CommandQueue", lambda *_: queue)
    failing = SimpleNamespace(
        queue=queue, errors=usual_device.errors, finish=lambda: Device.finish(failing), several_queues=True,
        context=None, info=SimpleNamespace(handle=None),
    )  # fmt: skip
    queues = Queues(failing, most)
    if (refused, most) == ("finish", 1):
        assert [piece for piece, _ in queues.dealt([1, 2])] == [1, 2]
        queues.wait()
        return
    with pytest.raises(DeviceError, match="INVALID_MEM_OBJECT"):
        list(queues.dealt([1, 2]))
    if refused == "finish":
        with pytest.raises(DeviceError, match="INVALID_MEM_OBJECT"):
            queues.wait()


# -------------------------------------------------------------------------------- tiles that are swept again


#: Two views of 3 and 2 tiles among others that are not cached.
TWO_VIEWS = [(1, 3), (4, 2)]
NEVER_SWEPT = np.full(5, np.inf, np.float32)


def staleness(*values: float):
    return np.array(values, np.float32)


def test_tiles_staler_than_the_tolerance():
    schedule = TileSchedule(SweepOptions(0.1), TWO_VIEWS)
    assert schedule.choose(3, staleness(0, 0.1, 0.2, 0.05, np.inf)).tolist() == [2, 4]


def test_the_first_measurement_takes_all_tiles_whatever_is_traded():
    schedule = TileSchedule(SweepOptions(0.1, turns=3), TWO_VIEWS)
    assert schedule.choose(0, NEVER_SWEPT).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("tolerance", "again"), [(-1.0, True), (0.0, False), (0.1, False)])
def test_swept_tiles_are_fresh_but_for_a_negative_tolerance(tolerance, again):
    schedule = TileSchedule(SweepOptions(tolerance), TWO_VIEWS)
    stale = NEVER_SWEPT.copy()
    schedule.note_swept(stale, np.array([0, 3]))
    chosen = schedule.choose(1, stale).tolist()
    assert chosen == ([0, 1, 2, 3, 4] if again else [1, 2, 4])


def test_changed_tiles_are_those_that_lost_anything():
    schedule = TileSchedule(SweepOptions(0.5, turns=7), TWO_VIEWS)
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


# -------------------------------------------------------------------------------- units of the totals


EYE = Camera("view", 16, 16, 10.0, 10.0, 8.0, 8.0, np.eye(3), np.zeros(3))

SIZES = st.lists(st.tuples(st.integers(1, 5000), st.integers(1, 5000)), min_size=1, max_size=20)


def cameras(sizes) -> list[Camera]:
    return [dataclasses.replace(EYE, width=width, height=height) for width, height in sizes]


def tiles(camera: Camera) -> int:
    return -(-camera.width // TILE) * -(-camera.height // TILE)


@given(SIZES, st.integers(-(2**62), 2**62), st.integers(0, 2**62))
def test_the_largest_sums_fit_and_values_are_totals_in_their_units(sizes, effect, importance):
    """Effects of 16 a pixel and channel are not cut."""
    views = cameras(sizes)
    units = FixedPoint.of_views(views)
    largest = 0.0
    for view in views:
        weight = units.weight(view.width * view.height)
        cut_at, scale = units.bound / weight, units.scale * weight  # as the kernels take them
        largest += tiles(view) * cut_at * scale
    assert largest <= 2.0**62 * (1 + 1e-12)
    assert units.bound == 16 * 3 * TILE * TILE
    assert np.log2(units.scale) % 1 == 0
    effects, importances = units.values(np.array([[effect, importance]], np.int64))
    assert effects[0] == pytest.approx(effect * units.units[0], rel=1e-14)
    assert importances[0] == pytest.approx(importance * units.units[1], rel=1e-14)


@given(SIZES)
def test_no_bit_is_wasted_where_all_views_are_of_a_size(sizes):
    views = cameras([sizes[0]] * len(sizes))
    area = (views[0].width + TILE - 1) * (views[0].height + TILE - 1)
    units = FixedPoint.of_views(views)
    assert 48.0 * area * len(views) * units.scale > 2.0**61


def test_a_pixel_of_any_view_counts_by_its_share_of_the_view():
    """An importance of 1 in every pixel is a mean of 1, whatever the views' sizes."""
    views = cameras([(40, 30), (16, 16), (100, 7)])
    units = FixedPoint.of_views(views)
    total = sum(v.width * v.height * units.scale * units.weight(v.width * v.height) for v in views)
    _, importances = units.values(np.array([[0, int(total)]], np.int64))
    assert importances[0] == pytest.approx(1, rel=1e-12)
