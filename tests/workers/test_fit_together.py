"""A fit by several devices gives the bits of one, whatever their number, and whoever is lost on the way."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from potr_cl.errors import DeviceError
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting import together
from potr_cl.stages.fitting.fit import FitOptions, Sight, fit_scene
from potr_cl.stages.fitting.together import FitPart
from potr_cl.views.shares import HelpFrom
from potr_cl.views.targets import RenderedTargets
from potr_cl.workers.host import HostPool
from tests.cases.elsewhere import ElsewherePool
from tests.devices import open_device
from tests.reference.scenes import ring_of_cameras, visible_scene

SOURCE = visible_scene(60, 2, seed=3)
START = dataclasses.replace(SOURCE, sh=0.8 * SOURCE.sh, opacity_logits=SOURCE.opacity_logits - np.float32(0.3))
#: Of two sizes: a launch has one fixed point for all of its views.
VIEWS = [*ring_of_cameras(6, size=40), *ring_of_cameras(5, size=57)]
OPTIONS = FitOptions(steps=9, rounds=2, batch=4)


def fitted(device, pool=None, options=OPTIONS):
    with Rasterizer(device, SOURCE) as rasterizer:
        help_from = None if pool is None else HelpFrom(pool, SOURCE)
        return fit_scene(device, START, Sight(VIEWS, RenderedTargets(rasterizer, VIEWS), help_from=help_from), options)


@pytest.fixture(scope="module")
def alone(family):
    result = fitted(open_device(family))
    assert result.kept == OPTIONS.steps
    return result


def same(one, other):
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    return one.errors == other.errors and all(
        np.array_equal(getattr(one.scene, name), getattr(other.scene, name)) for name in names
    )


@pytest.fixture
def steps(monkeypatch):
    """How many batches each device has found sums for."""
    found = []
    sums = FitPart.sums
    monkeypatch.setattr(FitPart, "sums", lambda self, *args: found.append(self) or sums(self, *args))
    return found


@pytest.mark.parametrize(
    ("kind", "count"), [(HostPool, 2), (ElsewherePool, 2), pytest.param(ElsewherePool, 4, marks=pytest.mark.slow)]
)
def test_the_same_bits(family, alone, kind, count, monkeypatch, steps):
    monkeypatch.setattr(together, "_TRIED", OPTIONS.steps)
    devices = [open_device(family) for _ in range(count)]
    with kind(devices) as pool:
        found = fitted(devices[0], pool)
        assert pool.traffic.received > 0
    assert same(found, alone)
    assert len(steps) == OPTIONS.steps * (count - 1)
    assert [device.allocated for device in devices] == [0] * count


@pytest.mark.one_family
@pytest.mark.parametrize("faster", ["alone", "together"])
def test_steps_are_taken_as_is_faster(family, alone, faster, monkeypatch, steps):
    """Who was left out of some steps is told what the others know by then."""
    monkeypatch.setattr(together, "_TRIED", 2)
    times = itertools.accumulate([0, 1, 2] if faster == "together" else [0, 2, 1])
    monkeypatch.setattr(together.time, "perf_counter", lambda: next(times))
    adopted = []
    adopt = FitPart.adopt
    monkeypatch.setattr(FitPart, "adopt", lambda self, *args: adopted.append(args[0]) or adopt(self, *args))
    devices = [open_device(family) for _ in range(2)]
    with HostPool(devices) as pool:
        assert same(fitted(devices[0], pool), alone)
    assert adopted == ([6] if faster == "together" else [])
    assert len(steps) == (4 + 3 + 1 if faster == "together" else 4)
    assert [device.allocated for device in devices] == [0] * 2


@pytest.mark.one_family
def test_after_a_fit_that_help_made_slower_others_go_alone(family, alone, monkeypatch, steps):
    monkeypatch.setattr(together, "_TRIED", 2)
    times = itertools.accumulate([0, 2, 1])
    monkeypatch.setattr(together.time, "perf_counter", lambda: next(times))
    devices = [open_device(family) for _ in range(2)]
    with HostPool(devices) as pool, Rasterizer(devices[0], SOURCE) as rasterizer:
        help_from, targets = HelpFrom(pool, SOURCE), RenderedTargets(rasterizer, VIEWS)
        for taken in (4, 4):
            found = fit_scene(devices[0], START, Sight(VIEWS, targets, help_from=help_from), OPTIONS)
            assert same(found, alone)
            assert len(steps) == taken


@pytest.mark.slow
@pytest.mark.one_family
@pytest.mark.parametrize(
    ("kind", "command", "lost"),
    [
        (HostPool, "__init__", "one"),
        (ElsewherePool, "sums", "one"),
        (HostPool, "sums", "all"),
        (ElsewherePool, "__init__", "all"),
    ],
)
def test_a_worker_that_is_lost(family, alone, kind, command, lost, monkeypatch, caplog):
    monkeypatch.setattr(together, "_TRIED", OPTIONS.steps)
    devices = [open_device(family) for _ in range(3)]
    real, calls = getattr(FitPart, command), []

    def failing(self, *args):
        device = args[0] if command == "__init__" else self._descent.device
        calls.append(device)
        if (lost == "all" and (command == "__init__" or len(calls) > 6)) or (
            device is devices[1] and calls.count(device) == (1 if command == "__init__" else 3)
        ):
            raise DeviceError("the device failed")
        return real(self, *args)

    monkeypatch.setattr(FitPart, command, failing)
    with kind(devices) as pool:
        assert same(fitted(devices[0], pool), alone)
    assert ("no worker can fit" in caplog.text) == (lost == "all")
    assert [device.allocated for device in devices] == [0] * 3


@pytest.mark.one_family
def test_a_pool_of_one_device_helps_nobody(family, alone):
    device = open_device(family)
    with HostPool([device]) as pool:
        assert same(fitted(device, pool), alone)
    assert device.allocated == 0
