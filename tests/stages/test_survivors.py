"""States of splats: the same names on host and device, and both agree after every change."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.source import kernel_source
from potr_cl.stages.pruning.buffers import SplatState, Survivors
from potr_cl.stages.pruning.resident import Queues

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


def test_all_are_alive_at_first(usual_device, survivors, waits):
    assert survivors.alive.tolist() == [True] * 5
    assert on_device(usual_device, survivors) == [ALIVE] * 8
    assert waits == []


def test_a_removal_is_news_to_the_device_until_it_is_settled(usual_device, survivors, waits):
    survivors.remove(np.array([1, 3]))
    just = [ALIVE, JUST_REMOVED, ALIVE, JUST_REMOVED, *[ALIVE] * 4]
    assert on_device(usual_device, survivors) == just
    assert waits == []
    assert survivors.alive.tolist() == [True, False, True, False, True]
    assert waits == [just]  # the kernels that look for them were waited for before the states changed
    assert on_device(usual_device, survivors) == [ALIVE, REMOVED, ALIVE, REMOVED, *[ALIVE] * 4]
    survivors.settle()
    assert len(waits) == 1


def test_what_the_device_has_marked_reaches_the_host(usual_device, survivors):
    marked = np.array([ALIVE, ALIVE, JUST_REMOVED, REMOVED, *[ALIVE] * 4], np.uint8)
    cl.enqueue_copy(usual_device.queue, survivors.buffer, marked, is_blocking=True)
    survivors.marked_by_device()
    assert survivors.alive.tolist() == [True, True, False, False, True]
    assert on_device(usual_device, survivors) == [ALIVE, ALIVE, REMOVED, REMOVED, *[ALIVE] * 4]


def test_removals_of_host_and_device_add_up(usual_device, survivors):
    survivors.remove(np.array([0]))
    survivors.settle()
    marked = np.array([REMOVED, JUST_REMOVED, *[ALIVE] * 6], np.uint8)
    cl.enqueue_copy(usual_device.queue, survivors.buffer, marked, is_blocking=True)
    survivors.marked_by_device()
    survivors.remove(np.array([4]))
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
            survivors.marked_by_device()
            told.mark(survivors.just_marked())
            told.marked_by_device()
            assert on_device(usual_device, told) == states.tolist()
        assert told.alive.tolist() == survivors.alive.tolist() == [False, False, True, True, False]


def test_a_mark_after_a_removal_by_the_host(usual_device, survivors):
    survivors.remove(np.array([0]))
    survivors.mark(np.array([0b10], np.uint8))
    survivors.marked_by_device()
    assert survivors.alive.tolist() == [False, False, True, True, True]


def refusing(*_args, **_more):
    raise cl.RuntimeError("clEnqueueWriteBuffer failed: INVALID_MEM_OBJECT")


def test_what_the_driver_refuses_is_told_in_one_line(survivors, monkeypatch):
    monkeypatch.setattr(cl, "enqueue_copy", refusing)
    with pytest.raises(DeviceError, match="INVALID_MEM_OBJECT"):
        survivors.remove(np.array([1]))
    monkeypatch.undo()


@pytest.mark.parametrize("refused", ["finish", "flush"])
def test_so_is_what_queues_refuse(usual_device, refused):
    queue = SimpleNamespace(finish=lambda: None, flush=lambda: None)
    setattr(queue, refused, refusing)
    failing = SimpleNamespace(queue=queue, errors=usual_device.errors, finish=lambda: Device.finish(failing))
    with pytest.raises(DeviceError, match="INVALID_MEM_OBJECT"):
        list(Queues(failing, 1).dealt([1, 2]))
