"""A device that is opened before somebody asks for it."""

from __future__ import annotations

import gc
from collections import defaultdict, deque
from contextlib import suppress
from types import SimpleNamespace

import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl import ahead
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device


@pytest.fixture
def contexts(monkeypatch):
    """The devices of which contexts are made, in their order."""
    made = []
    real = ahead.new_context

    def counted(handle):
        made.append(handle)
        return real(handle)

    gc.collect()  # devices of other tests leave their contexts now
    monkeypatch.setattr(ahead, "_begun", None)
    monkeypatch.setattr(ahead, "new_context", counted)
    monkeypatch.setattr(ahead, "_left", defaultdict(lambda: deque(maxlen=0)))  # nothing of other tests
    return made


def test_who_opens_a_device_again_and_again_has_one_context(contexts, monkeypatch):
    """Drivers never give back all that they take for one."""
    monkeypatch.setattr(ahead, "_left", defaultdict(lambda: deque(maxlen=1)))
    for _ in range(3):
        device = Device()
        device.shared_kernel("opencl/fill.cl", "fill")
        del device
    assert len(contexts) == 1
    with suppress(DeviceError), Device().errors("has failed"):
        raise cl.RuntimeError("of the device")
    Device()
    assert len(contexts) == 2  # that of a device that has failed is left to nobody


def test_what_was_begun_is_taken_once(contexts):
    info = choose_device()
    ahead.begin_to_open(None)
    first, second = Device(), Device()
    assert contexts == [info.handle] * 2
    assert first.context.devices == second.context.devices == [info.handle]
    assert first.context != second.context


@pytest.mark.parametrize("spec", ["no such device", "all", "0,1", None])
def test_whatever_was_begun_a_device_opens(spec, contexts):
    """Also where nothing has begun because the name fits no device, or several."""
    ahead.begin_to_open(spec, whole=spec is not None)
    device = Device()
    assert device.context.devices == [device.info.handle]
    with pytest.raises(DeviceError, match="no such device"):
        Device("no such device")


def test_a_context_of_another_device_is_left_alone(contexts):
    ahead.begin_to_open(None)
    other = SimpleNamespace(handle=object())
    with pytest.raises(AttributeError):  # an object is no device: it was asked all the same
        ahead.context_of(other)
    assert contexts == [choose_device().handle, other.handle]


def test_several_devices_are_begun_together(contexts, monkeypatch):
    info = choose_device()
    monkeypatch.setattr(ahead, "choose_devices", lambda spec: [info, info])
    ahead.begin_to_open("all")
    devices = [Device(info) for _ in range(3)]
    assert contexts == [info.handle] * 3  # two that were begun, and one more
    assert len({device.context.int_ptr for device in devices}) == 3
