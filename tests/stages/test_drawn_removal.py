"""Removal effects on a CPU, each view with the splats that it draws. Bits and choices: test_visible_parts.py."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model import splat_groups
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers, uploaded
from potr_cl.stages.pruning.drawn_removal import DrawnRemoval
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.views.visibility import Visibility
from tests.cases.streets import street
from tests.cases.sweeps import assert_same_bits
from tests.devices import open_device

#: Bytes that some of the street's views fit.
SOME = 1_500_000


@pytest.fixture(scope="module")
def device():
    device = open_device("cpu")
    yield device
    assert device.allocated == 0, "a sweep did not give all its memory back"


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)


def removal(device, memory, tolerance=0.0):
    scene, cameras = street()
    parts = Visibility.of(scene, cameras).clusters()
    return DrawnRemoval(device, scene, scene, cameras, parts, SweepOptions(tolerance, memory=memory))


def test_some_views_stay_and_others_pass(device):
    scene, cameras = street()
    with (
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, SweepOptions(0.0)) as wanted,
        removal(device, SOME) as got,
    ):
        assert 0 < got.kept_views < len(cameras)
        assert_same_bits(wanted, got, scene, np.random.default_rng(1))


@pytest.mark.parametrize("memory", [0, None])
def test_views_that_draw_nothing_are_views_too(device, memory):
    scene, cameras = street()
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + np.array([0, 0, -500.0]))
    cameras = [away, *cameras, away]
    parts, options = Visibility.of(scene, cameras).clusters(), SweepOptions(0.0, memory=memory)
    with (
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, SweepOptions(0.0)) as wanted,
        DrawnRemoval(device, scene, scene, cameras, parts, options) as got,
    ):
        assert got.kept_views == (2 if memory == 0 else len(cameras))
        assert_same_bits(wanted, got, scene, np.random.default_rng(1))


@pytest.mark.parametrize("memory", [SOME // 2, SOME, 2 * SOME])
def test_views_that_stay_keep_to_the_memory(device, memory):
    before = device.allocated
    with removal(device, memory) as drawn:
        assert drawn.kept_views > 0
        assert device.allocated - before <= memory


def test_views_that_pass_are_measured_when_they_have_lost_enough(device):
    with removal(device, 0) as exact, removal(device, 0, tolerance=0.01) as now_and_then:
        effects, importance = exact.measure()
        before = now_and_then.measure()
        assert np.array_equal(before[0], effects)
        seen = np.flatnonzero(importance)
        few = seen[np.argsort(importance[seen])[:20]]
        for each in (exact, now_and_then):
            each.remove(few)
        again = exact.measure()
        assert not np.array_equal(again[0], effects), "what was removed shows nowhere"
        assert np.array_equal(now_and_then.measure()[0], effects)
        many = np.argsort(importance)[-len(importance) // 4 :]
        for each in (exact, now_and_then):
            each.remove(many)
        left = exact.alive
        for wanted, got in zip(exact.measure(), now_and_then.measure(), strict=True):
            assert np.array_equal(wanted[left], got[left])


@pytest.mark.parametrize("sh_count", [1, 4])
def test_some_splats_of_the_host_go_to_the_device_as_all_do(device, sh_count):
    """Piece by piece, of more than one piece; also where no parameter has more columns than rotations have."""
    scene, _ = street(2, 50_000)
    scene = dataclasses.replace(scene, sh=scene.sh[:, :sh_count])
    assert scene.sh.shape[1] == sh_count
    splats = np.flatnonzero(np.arange(len(scene)) % 7 > 0)
    with (
        uploaded(device, scene.subset(splats)) as wanted,
        SceneBuffers(device, len(splats), scene.sh.shape[1]) as got,
    ):
        got.write_some(scene, splats)
        for name, buffer in wanted.parameters.items():
            size = (buffer.size // 4,)
            found = device.download(got.parameters[name], size, np.float32)
            assert np.array_equal(found, device.download(buffer, size, np.float32)), name
