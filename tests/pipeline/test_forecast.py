"""What an encode will take grows with what there is to do."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline import forecast as forecasts
from potr_cl.pipeline.forecast import forecast
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0


class Clock:
    """Pictures take what a test says, whatever else keeps the machine busy; and which have been rendered."""

    def __init__(self, monkeypatch) -> None:
        self.now, self.calls = 0.0, 0
        render = Rasterizer.render_device

        def rendered(rasterizer, camera):
            self.calls += 1
            self.now += self.takes(self.calls)
            return render(rasterizer, camera)

        monkeypatch.setattr(Rasterizer, "render_device", rendered)
        monkeypatch.setattr(forecasts, "time", SimpleNamespace(perf_counter=lambda: self.now))

    def takes(self, call: int) -> float:
        return 0.01


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


@pytest.fixture
def ahead(device, plush_excerpt, plush_excerpt_cameras, clock):
    """Forecasts in units of a picture's time."""

    def of(options: EncodeOptions, views: int = 9, search: bool = False) -> float:
        found = forecast(plush_excerpt, train_views(plush_excerpt_cameras)[:views], options, device, search)
        assert found.sampled > 0
        assert found.memory > 0
        return found.seconds / found.sampled

    return of


def test_more_work_takes_longer(ahead):
    best = EncodeOptions()
    whole = ahead(best)
    assert ahead(best, search=True) > 2 * whole
    assert ahead(best.changed(prune={"iterations": 480})) > 1.5 * whole
    assert ahead(best.changed(prune=False)) < 0.9 * whole
    assert ahead(best.changed(refit={"steps": 80})) > 1.5 * whole
    assert ahead(best.changed(fit={"steps": 1000})) > 2 * whole
    assert ahead(best, views=4) < 0.7 * whole


def test_a_fit_of_more_splats_takes_longer(ahead):
    fit = EncodeOptions.for_preset("best", fit={"steps": 1000})
    assert ahead(fit.changed(q=0.5)) > 1.3 * ahead(fit.changed(q=0.3))
    assert ahead(fit.changed(fit={"rounding": 1.0})) > 1.5 * ahead(fit), "steps after roundings count"


@pytest.mark.parametrize("busy", [(3,), (2, 9, 17), (1, 2)], ids=str)
def test_what_takes_the_device_away_for_a_moment_does_not_count(
    device, plush_excerpt, plush_excerpt_cameras, clock, busy
):
    """Pictures of some milliseconds; before some of them the device is away for a quarter of a second."""
    clock.takes = lambda call: 0.25 if call in busy else 0.002
    ahead = forecast(plush_excerpt, train_views(plush_excerpt_cameras), EncodeOptions(), device)
    assert ahead.sampled == pytest.approx(0.002)
    assert clock.calls > 9


def test_pictures_that_take_long_are_rendered_once(device, plush_excerpt, plush_excerpt_cameras, clock):
    clock.takes = lambda call: 0.05
    ahead = forecast(plush_excerpt, train_views(plush_excerpt_cameras), EncodeOptions(), device)
    assert ahead.sampled == pytest.approx(0.05)
    assert clock.calls == 5


def test_memory_is_that_of_views_and_stays_within_the_budget(device, plush_excerpt, plush_excerpt_cameras):
    views = train_views(plush_excerpt_cameras)

    def memory(cameras, **changes):
        return forecast(plush_excerpt, cameras, EncodeOptions().changed(**changes), device).memory

    few, many = memory(views), memory(views * 20)
    assert few < many
    assert memory(views * 20, memory=0) < few
    large = [dataclasses.replace(view, width=4 * view.width, height=4 * view.height) for view in views]
    assert memory(large) > few + 12 * 15 * 9 * 240 * 180


def test_memory_of_a_large_scene_is_what_is_allowed(device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    if device.info.kind != "cpu":
        pytest.skip("a GPU's memory is not the host's")
    views = train_views(plush_excerpt_cameras)[:3] * 100
    allowed = EncodeOptions().changed(memory=1 << 20)
    monkeypatch.setattr(forecasts, "LEAST_SPLATS", len(plush_excerpt) + 1)
    small = forecast(plush_excerpt, views, allowed, device).memory
    monkeypatch.setattr(forecasts, "LEAST_SPLATS", len(plush_excerpt))
    large = forecast(plush_excerpt, views, allowed, device).memory
    assert large < small - 1e6, "what the host has of the scene lies in files"
    assert large < forecast(plush_excerpt, views, EncodeOptions(), device).memory


def test_half_of_what_takes_the_time_is_seen(device, plush_excerpt, plush_excerpt_cameras):
    """A coarse bound on a real encode; tools.bench.forecast measures how far off it is."""
    from potr_cl.pipeline.encode import encode

    options = EncodeOptions.for_preset("best", prune={"iterations": 400, "tolerance": 0.0})
    views = train_views(plush_excerpt_cameras)
    encode(plush_excerpt, views, options.changed(prune={"iterations": 2}), device=device)  # compiles
    expected = forecast(plush_excerpt, views, options, device).seconds
    took = sum(encode(plush_excerpt, views, options, device=device).seconds.values())
    assert expected / 20 < took < 20 * expected
