"""What a view takes, told from few; by a clock that goes on when a picture is rendered and at no other time."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from potr_cl.model import splat_groups
from potr_cl.pipeline import sampled_views
from potr_cl.pipeline.sampled_views import sample_views
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning import visible_parts
from tests.cases.streets import street
from tests.devices import FAMILIES, open_device


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0


@pytest.fixture
def on_cpu(device):
    if device.family != "cpu":
        pytest.skip("views are rendered with all splats on a GPU")
    return device


class Clock:
    """Stands for the module time, and notes what was rendered.

    Attributes:
        calls: name of the view and number of splats of each picture.
    """

    def __init__(self, takes, slow=1.0) -> None:
        self.wall = self.work = 0.0
        self.calls: list[tuple[str, int]] = []
        self._takes, self._slow = takes, slow

    def perf_counter(self) -> float:
        return self.wall

    def process_time(self) -> float:
        return self.work

    @staticmethod
    def get_clock_info(_name):
        return SimpleNamespace(resolution=1e-9)

    def rendered(self, camera, splats: int) -> None:
        work = self._takes(camera, splats)
        self.calls.append((camera.name, splats))
        self.work += work
        self.wall += work * (self._slow(len(self.calls)) if callable(self._slow) else self._slow)


@pytest.fixture
def timed(monkeypatch):
    """Have pictures take so long, as a function of the camera and of how many splats are projected."""

    def of(takes, slow=1.0) -> Clock:
        clock = Clock(takes, slow)
        monkeypatch.setattr(sampled_views, "time", clock)
        monkeypatch.setattr(Rasterizer, "render_device", lambda self, camera: clock.rendered(camera, self.splats))
        return clock

    return of


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)


@pytest.fixture
def large(monkeypatch):
    """Scenes of few splats are looked at in parts."""
    for module in (sampled_views, visible_parts):
        monkeypatch.setattr(module, "LEAST_SPLATS", 1)


def in_front(scene, camera) -> bool:
    """Whether a view looks at anything."""
    return bool((scene.means @ camera.rotation[2] + camera.translation[2] > 0).any())


def test_splats_that_are_in_no_picture_are_told_apart(on_cpu, timed):
    scene, cameras = street()
    timed(lambda camera, splats: 0.04 * in_front(scene, camera) + 1e-6 * splats)
    found = sample_views(scene, cameras, on_cpu)
    assert found.splats == len(scene)
    assert found.splat == pytest.approx(1e-6)
    assert found.picture == pytest.approx(0.04)
    assert found.seconds == pytest.approx(0.04 + 1e-6 * len(scene))
    assert 0 < found.lists < found.nbytes


def test_views_of_a_large_scene_are_rendered_with_what_they_may_draw(on_cpu, timed, large):
    scene, cameras = street(8, 300, across=True)
    clock = timed(lambda camera, splats: 0.04 * in_front(scene, camera) + 1e-6 * splats)
    found = sample_views(scene, cameras, on_cpu)
    assert all(splats < len(scene) / 2 for _, splats in clock.calls)
    assert found.splats < len(scene) / 2
    assert found.splat == pytest.approx(1e-6)
    assert found.picture == pytest.approx(0.04)
    assert found.nbytes < sample_views(scene, cameras * 2, on_cpu).nbytes * 1.5


def test_views_that_see_much_count_as_often_as_they_are(on_cpu, timed):
    """One view of 25 sees the whole street and takes 50 times as long; wherever it stands among them."""
    scene, cameras = street(8, 300, across=True)
    far = next(camera for camera in cameras if camera.name == "along")
    others = [camera for camera in cameras if camera is not far]
    timed(lambda camera, splats: (1.0 if camera.name == "along" else 0.02) * in_front(scene, camera))
    mean = (1.0 + 0.02 * len(others)) / len(cameras)
    for place in (0, 11, len(others)):
        found = sample_views(scene, [*others[:place], far, *others[place:]], on_cpu)
        assert 0.0199 < found.picture < 1.5 * mean


def test_more_to_see_takes_longer(on_cpu, timed):
    """What is measured with few views is made up for where these see more, or less, than all of them."""
    scene, cameras = street(8, 300)
    parts = sampled_views.parts_seen(scene, cameras, 0.2)
    assert np.ptp(parts) > 0.1
    part_of = {camera.name: part for camera, part in zip(cameras, parts, strict=True)}
    timed(lambda camera, splats: (0.01 + part_of[camera.name]) * in_front(scene, camera))
    assert sample_views(scene, cameras, on_cpu).picture == pytest.approx(0.01 + parts.mean(), rel=1e-6)


def test_other_work_on_the_machine(on_cpu, timed):
    """What slows all down counts. How a picture divides is told by what the processors did."""
    scene, cameras = street()

    def takes(camera, splats: int) -> float:
        return 0.004 * in_front(scene, camera) + 1e-7 * splats

    timed(takes, slow=7.0)
    found = sample_views(scene, cameras, on_cpu)
    assert found.picture == pytest.approx(7 * 0.004)
    assert found.splat == pytest.approx(7e-7)
    # Away for a moment, again and again.
    timed(takes, slow=lambda number: 60.0 if number in (3, 10, 18) else 1.0)
    assert sample_views(scene, cameras, on_cpu).picture == pytest.approx(0.004)


def test_views_that_see_nothing(on_cpu, timed, large):
    scene, cameras = street(2, 100)
    blind = [dataclasses.replace(camera, translation=np.array([0, 0, -1e3])) for camera in cameras]
    timed(lambda camera, splats: 1e-6 * splats)
    found = sample_views(scene, blind, on_cpu)
    assert found.picture == pytest.approx(0, abs=1e-12)
    assert found.splats <= 1
    assert found.nbytes > 0


def test_pictures_that_take_long_are_rendered_once(device, timed):
    scene, cameras = street()
    clock = timed(lambda camera, splats: 0.05)
    assert sample_views(scene, cameras, device).seconds == pytest.approx(0.05)
    # The first one makes buffers; on a CPU one more looks away.
    assert len(clock.calls) == (6 if device.family == "cpu" else 5)
    assert len({name for name, _ in clock.calls}) <= 5
    quick = timed(lambda camera, splats: 1e-4)
    sample_views(scene, cameras, device)
    assert len(quick.calls) > 3 * len(clock.calls)
