"""Levels that are made at the same time."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from potr_cl import DeviceError
from potr_cl.levels import encoding, slots
from potr_cl.levels.slots import Slot, side_by_side, slots_on
from potr_cl.opencl.discovery import choose_device
from potr_cl.pipeline.options import EncodeOptions
from tests.devices import shared_device

TWO = [Slot(None), Slot(None)]


@pytest.fixture(scope="module")
def device():
    return shared_device(choose_device().family)


def test_each_work_is_done_once():
    done = []

    def work(number, slot, report):
        report("work", 0.5)
        if number < 20:
            done.append(number)
        return number < 20

    told = []
    side_by_side(work, [Slot(None)] * 3, lambda what, part: told.append(what))
    assert sorted(done) == list(range(20))
    assert 0 < len(told) <= 21


@pytest.mark.parametrize("fails", [0, 1])
def test_a_failure_ends_the_others(fails):
    begun = threading.Barrier(2, timeout=20)

    def work(number, slot, report):
        begun.wait()
        if number == fails:
            raise ValueError(f"work {number}")
        while True:
            report("work", 0.5)

    with pytest.raises(ValueError, match=f"work {fails}"):
        side_by_side(work, TWO, None)


def test_an_interrupt_ends_the_others():
    begun = threading.Barrier(2, timeout=20)

    def work(number, slot, report):
        begun.wait()
        if number == 0:
            raise KeyboardInterrupt
        while True:
            report("work", 0.5)

    with pytest.raises(KeyboardInterrupt):
        side_by_side(work, TWO, None)


@pytest.mark.parametrize(
    ("memory", "shared", "asked", "slots"),
    [(100, False, None, 2), (100, False, 50, 1), (100, True, None, 1), (40, False, None, 1)],
)
def test_a_gpu_makes_two_levels_where_it_has_room(memory, shared, asked, slots):
    info = SimpleNamespace(memory=memory * 10**9, shares_host_memory=shared)
    assert slots_on(SimpleNamespace(info=info), 2 * 10**9, asked) == slots


def test_a_device_that_cannot_be_opened_again_makes_one_level_after_the_other(monkeypatch, device):
    def refuse(_):
        raise DeviceError("it is taken")

    memory = device.info.memory
    monkeypatch.setattr(slots, "Device", refuse)
    monkeypatch.setattr(slots, "slots_on", lambda *_: 2)
    with slots.slots(device, None, 1, EncodeOptions()) as found:
        assert found == [Slot(device)]
        found[0].share()
        assert device.info.memory == memory


@pytest.mark.parametrize("preset", ["fast", pytest.param("smallest", marks=pytest.mark.slow)])
def test_the_file_is_the_same_however_many_are_made_at_a_time(
    monkeypatch, plush_excerpt, plush_excerpt_cameras, device, preset
):
    options = EncodeOptions(preset=preset, levels=3).changed(fit={"steps": 8})
    memory, files = device.info.memory, []
    for number in (1, 2, 3):
        monkeypatch.setattr(slots, "slots_on", lambda *_, number=number: number)
        made = encoding.encode_levels(plush_excerpt, plush_excerpt_cameras, options, None, device, in_frame=True)
        files.append(made.data)
        assert device.info.memory == memory
    assert len(made.levels) == 3
    assert files[1] == files[2] == files[0]
