"""What an encode will take grows with what there is to do."""

from __future__ import annotations

import dataclasses
import time
from types import SimpleNamespace

import pytest

from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline import forecast as forecasts
from potr_cl.pipeline.forecast import forecast
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.sampled_views import SampledViews


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0


@pytest.fixture
def sampled(monkeypatch, plush_excerpt):
    """Views take what is said here, whatever the machine does meanwhile."""

    def of(**changes) -> None:
        splats = changes.get("splats", len(plush_excerpt))
        found = SampledViews(picture=0.01, splat=1e-8, splats=splats, nbytes=2e6)
        monkeypatch.setattr(forecasts, "sample_views", lambda *_: dataclasses.replace(found, **changes))

    of()
    return of


@pytest.fixture
def ahead(device, sampled, plush_excerpt, plush_excerpt_cameras):
    """Forecasts in units of a picture's time."""

    def of(options: EncodeOptions, views: int = 9, search: bool = False) -> float:
        found = forecast(plush_excerpt, train_views(plush_excerpt_cameras)[:views], options, device, search)
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
    assert ahead(best.changed(refit={"at": (0.3, 0.6)})) > 1.3 * whole
    assert ahead(best.changed(fit={"steps": 1000})) > 2 * whole
    assert ahead(best, views=4) < 0.7 * whole


def test_what_no_view_shows_takes_less_than_what_it_shows(device, ahead, sampled):
    """A large scene costs by what views show of it, and by the splats that are left for the re-fit."""
    if device.family != "cpu":
        pytest.skip("splats are not told apart on GPUs")
    best = EncodeOptions()
    pruned = best.changed(refit=False, between=False)
    sampled(splat=1e-5)
    whole, without_refit = ahead(best), ahead(pruned)
    sampled(splat=1e-5, splats=150)
    # What is seen is a tenth, and so a picture takes 0.0115 instead of 0.025 s.
    assert ahead(pruned) * 0.0115 < 0.95 * without_refit * 0.025
    assert ahead(best) * 0.0115 > 0.7 * whole * 0.025
    few, many = (ahead(best.changed(prune={"keep": part})) for part in (0.2, 0.9))
    assert many > 1.3 * few


def test_views_without_room_take_longer(device, ahead, sampled):
    """What the memory has no room for is made again in each iteration: lists, or only projections."""
    if device.family != "cpu":
        pytest.skip("a GPU makes such views again only now and then")
    best = EncodeOptions().changed(between=False)
    sampled(splat=1e-6)
    room = 2e6 * 9
    enough = ahead(best.changed(memory=int(4 * room)))
    assert enough == ahead(best)
    lists = 2e6 - 48 * 1500
    some = ahead(best.changed(memory=int(9 * lists + 4 * 48 * 1500)))
    none = ahead(best.changed(memory=0))
    assert enough < some < none / 2


def test_no_more_views_are_added_than_there_is_room_for(device, ahead, sampled):
    if device.family != "cpu":
        pytest.skip("on a GPU as many are added as the scene needs")
    auto, none = EncodeOptions(), EncodeOptions().changed(between={"views": 0})
    assert ahead(auto) > 1.2 * ahead(none)
    sampled(nbytes=float(device.info.memory))  # whatever this machine has
    assert ahead(auto) == ahead(none)


def test_a_fit_of_more_splats_takes_longer(ahead):
    fit = EncodeOptions.for_preset("best", fit={"steps": 1000})
    assert ahead(fit.changed(q=0.5)) > 1.3 * ahead(fit.changed(q=0.3))
    assert ahead(fit.changed(fit={"rounding": 1.0})) > 1.5 * ahead(fit), "steps after roundings count"


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


def test_half_of_what_takes_the_time_is_seen(device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """A coarse bound on a real encode; tools.bench.forecast measures how far off it is."""
    from potr_cl.pipeline import sampled_views, stopwatch
    from potr_cl.pipeline.encode import encode

    if device.info.kind == "cpu":  # by a clock that stands still while others have the processors
        clocks = {"perf_counter": time.process_time, "process_time": time.process_time}
        for module in (sampled_views, stopwatch):
            monkeypatch.setattr(module, "time", SimpleNamespace(**clocks, get_clock_info=time.get_clock_info))
    options = EncodeOptions.for_preset("best", prune={"iterations": 400, "tolerance": 0.0})
    views = train_views(plush_excerpt_cameras)
    encode(plush_excerpt, views, options.changed(prune={"iterations": 2}), device=device)  # compiles
    expected = forecast(plush_excerpt, views, options, device).seconds
    took = sum(encode(plush_excerpt, views, options, device=device).seconds.values())
    assert expected / 20 < took < 20 * expected
