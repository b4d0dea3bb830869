"""Several threads on one device: none takes memory or arguments from another, also when one is cancelled."""

from __future__ import annotations

import contextlib
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.opencl.device import Device
from potr_cl.opencl.program_cache import building
from potr_cl.raster.rasterizer import Rasterizer, render
from tests.reference.scenes import random_scene, ring_of_cameras


@pytest.fixture(scope="module")
def device() -> Device:
    return Device()


def test_a_thread_that_fails_takes_nothing_from_another(device: Device) -> None:
    """Each gives back what it has taken itself, whatever the order in which they come and go."""
    before = device.allocated
    entered, failed = threading.Event(), threading.Event()
    array = np.arange(1000, dtype=np.uint32)
    kept: list[cl.Buffer] = []

    def goes_on() -> None:
        with device.all_or_nothing():
            entered.wait(120)  # now the other one has begun, and is the last that did
            kept.append(device.upload(array, "a test"))
            failed.set()
            cancelled.exception(120)
            kept.append(device.upload(array + 1, "a test"))

    def is_cancelled() -> None:
        with device.all_or_nothing():
            entered.set()
            failed.wait(120)
            device.allocate(1000, "a test")
            raise KeyboardInterrupt

    with ThreadPoolExecutor(2) as pool:
        cancelled = pool.submit(is_cancelled)
        pool.submit(goes_on).result(120)
        assert isinstance(cancelled.exception(), KeyboardInterrupt)
    for number, buffer in enumerate(kept):
        assert np.array_equal(device.download(buffer, array.shape, array.dtype), array + number)
    assert device.allocated == before + sum(buffer.size for buffer in kept)
    for buffer in kept:
        device.free(buffer)
    assert device.allocated == before


def test_what_another_thread_frees_is_not_freed_again(device: Device) -> None:
    before = device.allocated

    with ThreadPoolExecutor(1) as pool, contextlib.suppress(ValueError), device.all_or_nothing():
        pool.submit(device.free, device.allocate(1000, "a test")).result()
        raise ValueError("x")
    assert device.allocated == before


def test_threads_share_no_kernel(device: Device) -> None:
    """One would bind arguments between another's binding and its launch."""
    make = partial(device.shared_kernel, "opencl/probe.cl", "probe_integers", LANES=1)
    with ThreadPoolExecutor(1) as pool:
        assert make() is make()
        assert pool.submit(make).result() is not make()


def test_two_threads_render_on_one_device_while_others_are_cancelled(device: Device) -> None:
    """What crashed: buffers of a thread that went on were freed with those of one that was cancelled."""
    cameras = ring_of_cameras(3, size=32)
    scenes = [random_scene(200, 0, seed=number) for number in range(2)]
    wanted = [[render(scene, camera, device=device)[0] for camera in cameras] for scene in scenes]
    before = device.allocated
    end = threading.Event()

    def draw(number: int) -> list[np.ndarray]:
        for _ in range(12):
            with device.all_or_nothing(), Rasterizer(device, scenes[number]) as rasterizer:
                pictures = [rasterizer.render(camera)[0] for camera in cameras]
        return pictures

    def is_cancelled() -> None:
        while not end.is_set():
            with contextlib.suppress(KeyboardInterrupt), device.all_or_nothing():
                rasterizer = Rasterizer(device, scenes[0])
                rasterizer.render(cameras[0])
                raise KeyboardInterrupt

    with ThreadPoolExecutor(3) as pool:
        cancelled = pool.submit(is_cancelled)
        drawn = [pool.submit(draw, number) for number in range(2)]
        try:
            assert np.array_equal([future.result() for future in drawn], wanted)
        finally:
            end.set()
        cancelled.result()
    assert device.allocated == before


def test_programs_are_built_at_the_same_time_and_each_once() -> None:
    """Two threads that want one program: the second waits; another program does not. Warnings come back afterwards."""
    inside, done = threading.Event(), threading.Event()
    order: list[str] = []
    filters = list(warnings.filters)

    def first() -> None:
        with building("a", alone=False):
            inside.set()
            done.wait(120)
            order.append("first")

    def second() -> None:
        with building("a", alone=False):
            order.append("second")

    with ThreadPoolExecutor(2) as pool:
        threads = [pool.submit(first)]
        inside.wait(120)
        threads.append(pool.submit(second))
        with building("b", alone=False):
            order.append("another")
        done.set()
        for thread in threads:
            thread.result(120)
    assert order == ["another", "first", "second"]
    assert warnings.filters == filters


def test_compilers_of_cpus_are_called_one_after_another() -> None:
    begun = threading.Event()

    def other() -> None:
        with building("b", alone=True):
            begun.set()

    with ThreadPoolExecutor(1) as pool:
        with building("a", alone=True):
            pool.submit(other)
            assert not begun.wait(0.3)
        assert begun.wait(120)
