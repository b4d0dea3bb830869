"""Scenes that do not fit a device: less memory, then a CPU, and one line that says so."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.fallback import with_fallback
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.views.budget import default_memory
from tests.devices import skip_without_cpu
from tests.reference.scenes import random_scene, ring_of_cameras

# Tolerance 0: views that are made anew each time are swept in full, and so are those that are kept.
OPTIONS = EncodeOptions.for_preset("paper", prune={"iterations": 3, "tolerance": 0})
SCENE = random_scene(400, 1)
CAMERAS = ring_of_cameras(32, size=96)


def with_memory(device: Device, memory: int, kind: str = "cpu") -> Device:
    """The same device, with less memory than it has."""
    device.info = dataclasses.replace(device.info, memory=memory, largest_buffer=memory, kind=kind)
    return device


def peak(options: EncodeOptions) -> int:
    """The most memory that an encode takes."""
    device = Device()
    taken = []
    allocate = device.allocate

    def watched(nbytes, what):
        buffer = allocate(nbytes, what)
        taken.append(device.allocated)
        return buffer

    device.allocate = watched
    encode(SCENE, CAMERAS, options, device=device)
    return max(taken)


@pytest.fixture(scope="module")
def peaks():
    """Peak with everything kept, and with nothing kept."""
    nothing = OPTIONS.changed(memory=0)
    everything = OPTIONS.changed(memory=1 << 30)
    return peak(everything), peak(nothing)


@pytest.fixture(scope="module")
def wanted():
    return b"".join(encode(SCENE, CAMERAS, OPTIONS).pieces)


def test_less_is_kept_until_it_fits(peaks, wanted, caplog):
    everything, nothing = peaks
    assert nothing < 0.7 * everything
    device = with_memory(Device(), (everything + nothing) // 2)
    generous = OPTIONS.changed(memory=1 << 30)
    with caplog.at_level(logging.WARNING, "potr_cl"):
        encoded = encode(SCENE, CAMERAS, generous, device=device)
    assert b"".join(encoded.pieces) == wanted
    assert encoded.device is device
    assert device.allocated == 0
    lines = [record.getMessage() for record in caplog.records]
    assert 1 <= len(lines) <= 2
    assert all("ran out of memory: again with" in line for line in lines)


def test_a_cpu_takes_over(peaks, wanted, caplog):
    skip_without_cpu()
    device = with_memory(Device(), peaks[1] // 2, "gpu")
    with caplog.at_level(logging.WARNING, "potr_cl"):
        encoded = encode(SCENE, CAMERAS, OPTIONS, device=device)
    assert b"".join(encoded.pieces) == wanted
    assert encoded.device.info.kind == "cpu"
    assert encoded.device is not device
    assert device.allocated == 0
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 3
    assert "going on with" in lines[-1]


def test_nothing_is_left_to_try(peaks, monkeypatch):
    with pytest.raises(DeviceMemoryError, match="cannot hold"):
        encode(SCENE, CAMERAS, OPTIONS, device=with_memory(Device(), peaks[1] // 2))

    def none(_spec):
        raise DeviceError("no OpenCL device fits 'cpu'")

    monkeypatch.setattr("potr_cl.pipeline.fallback.choose_device", none)
    with pytest.raises(DeviceMemoryError, match="cannot hold"):
        encode(SCENE, CAMERAS, OPTIONS, device=with_memory(Device(), peaks[1] // 2, "gpu"))


def test_other_failures_are_not_tried_again():
    calls = []

    def work(_device, _memory):
        calls.append(1)
        raise DeviceError("vanished")

    with pytest.raises(DeviceError, match="vanished"):
        with_fallback(Device(), None, work)
    assert len(calls) == 1


@pytest.mark.parametrize(
    "error",
    [
        cl.MemoryError("clEnqueueNDRangeKernel failed: MEM_OBJECT_ALLOCATION_FAILURE"),
        cl.RuntimeError("clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES"),
        cl.RuntimeError("clFinish failed: OUT_OF_HOST_MEMORY"),
        MemoryError("std::bad_alloc"),
    ],
    ids=str,
)
def test_memory_errors_of_the_driver_count_too(caplog, error):
    """Drivers may promise memory and fail when it is used: clEnqueue… says so then."""
    budgets = []

    def work(_device, memory):
        budgets.append(memory)
        if len(budgets) < 3:
            raise error
        return np.pi

    device = Device()
    with caplog.at_level(logging.WARNING, "potr_cl"):
        assert with_fallback(device, None, work) == (np.pi, device)
    assert budgets == [None, default_memory(device) // 8, 0]
