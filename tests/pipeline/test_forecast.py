"""The memory that an encode is said to take."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline import forecast
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.forecast import memory_needed
from potr_cl.pipeline.options import EncodeOptions


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0


@pytest.fixture
def memory(device, plush_excerpt):
    return lambda views, **changes: memory_needed(plush_excerpt, views, EncodeOptions().changed(**changes), device)


def test_memory_is_that_of_views_and_stays_within_the_budget(memory, plush_excerpt_cameras):
    views = train_views(plush_excerpt_cameras)
    few, many = memory(views), memory(views * 20)
    assert few < many
    assert memory(views * 20, memory=0) < few
    assert memory(views, between={"views": 3}) > memory(views, between=False)
    assert memory(views, fit={"steps": 9}) > few
    large = [dataclasses.replace(view, width=4 * view.width, height=4 * view.height) for view in views]
    assert memory(large) > few + 12 * 15 * 9 * 240 * 180


def test_memory_of_a_large_scene_is_what_is_allowed(memory, device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    if device.info.kind != "cpu":
        pytest.skip("a GPU's memory is not the host's")
    views = train_views(plush_excerpt_cameras)[:3] * 100
    small = memory(views, memory=1 << 20)
    monkeypatch.setattr(forecast, "LEAST_SPLATS", len(plush_excerpt))
    large = memory(views, memory=1 << 20)
    assert large < small - 1e6, "what the host has of the scene lies in files"
    assert large < memory(views)


@dataclasses.dataclass
class City:
    """What is asked of a scene of SH degree 3."""

    splats: int
    sh = np.empty((1, 16, 3))

    def __len__(self):
        return self.splats

    @property
    def nbytes(self):
        return 236 * self.splats


@pytest.mark.parametrize(
    ("splats", "gigabytes", "given", "measured"),
    [
        (10e6, 150.1, None, 68.8), (50e6, 150.1, None, 96.4), (50e6, 85.0, None, 71.5), (50e6, 150.1, 25.8, 43.0),
    ],
)  # fmt: skip
def test_memory_of_cities_is_about_what_was_measured(splats, gigabytes, given, measured):
    """On one H200 or H100, whose views filled what they may take."""
    scene = City(int(splats))
    device = SimpleNamespace(info=SimpleNamespace(memory=int(gigabytes * 1e9)))
    memory = None if given is None else int(given * 1e9)
    said = forecast._of_large(scene, memory or gigabytes * 0.5e9, memory, device)
    assert 0.85 * measured < said / 1e9 < 1.2 * measured


@pytest.mark.slow
def test_views_take_about_what_is_said(memory, device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    views, most = train_views(plush_excerpt_cameras) * 5, 0

    def progress(stage: str, done: float) -> None:
        nonlocal most
        most = max(most, device.allocated if stage == "prune" else 0)

    options = EncodeOptions().changed(between=False, prune={"iterations": 4})
    said = memory(views, between=False) - memory(views, between=False, memory=0)
    encode(plush_excerpt, views, options, progress, device)
    assert said / 3 < most < 3 * said
