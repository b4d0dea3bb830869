"""Peaks of memory: how they are taken, and the line through them."""

from __future__ import annotations

import sys

import pytest

from potr_cl.errors import DeviceError
from tools.bench import memory_growth
from tools.bench.memory_growth import CountingDevice, Point, fitted


def test_the_most_that_was_allocated():
    device = CountingDevice()
    device.enter("prepare views", 0.0)
    held = device.allocated
    one = device.allocate(1000, "one")
    two = device.allocate(500, "two")
    device.free(one)
    three = device.allocate(200, "three")
    device.enter("refit", 0.0)
    four = device.allocate(100, "four")
    assert device.peaks["prune"] >= held + 1500
    assert device.peaks["refit"] >= held + 800
    with pytest.raises(DeviceError):
        device.allocate(1 << 60, "too much")
    assert max(device.peaks.values()) < held + (1 << 20)
    for buffer in (two, three, four):
        device.free(buffer)


def test_the_line_through_the_peaks():
    points = [
        Point(n, v, None, host=1e6 + 300 * n + 5e3 * v + 48 * n * v, device=2e6) for n in (1e4, 5e4) for v in (10, 40)
    ]
    solution, deviation = fitted(points, "host")
    assert solution == pytest.approx([1e6, 300, 5e3, 48], rel=1e-6)
    assert deviation < 1e-9
    assert fitted(points, "device")[0][0] == pytest.approx(2e6)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the host's peak is Linux's figure")
def test_peaks_grow_and_the_budget_is_obeyed():
    def peaks(splats: int, views: int, memory: int | None = None) -> Point:
        passed = ["--like", str(memory_growth.EXCERPT), "--size", "100x100", "--iterations", "2"]
        return memory_growth.in_process(Point(splats, views, memory), passed)

    small, large = peaks(2000, 3), peaks(8000, 6)
    assert large.host > small.host > 0
    assert large.device > small.device > 0
    nothing = peaks(8000, 6, 0)
    whole = large.device - nothing.device
    half = peaks(8000, 6, int(whole / 2))
    assert 0 < half.device - nothing.device <= 1.1 * whole / 2
