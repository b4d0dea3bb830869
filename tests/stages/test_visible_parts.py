"""Removal effects part by part: the same bits as with all splats for all views."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model import splat_groups
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import gathered, uploaded
from potr_cl.stages import prune
from potr_cl.stages.pruning import measured
from potr_cl.stages.pruning.drawn_removal import DrawnRemoval
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.pruning.visible_parts import PartedRemoval
from potr_cl.views import visibility
from potr_cl.views.visibility import Visibility
from tests.cases.streets import street
from tests.cases.sweeps import assert_same_bits
from tests.devices import KERNELS, open_device


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a sweep did not give all its memory back"


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)


@pytest.fixture(params=[PartedRemoval, DrawnRemoval])
def parted(request):
    def made(device, scene, cameras, options, whole=None):
        parts = Visibility.of(scene, cameras).clusters()
        assert 3 <= len(parts) < len(cameras)
        return request.param(device, scene, whole or scene, cameras, parts, options)

    return made


@pytest.mark.parametrize(
    ("memory", "tolerance"),
    [(None, 0.0), (None, 0.05), (300_000, 0.0), (0, 0.0)],
    ids=["all fits", "all fits, tolerance", "some fits", "nothing fits"],
)
def test_the_same_bits(device, parted, memory, tolerance):
    """While splats go and colours change. Which views are kept is another matter: so none may be skipped there."""
    scene, cameras = street()
    options = SweepOptions(tolerance, memory=memory)
    rng = np.random.default_rng(1)
    with (
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, options) as wanted,
        parted(device, scene, cameras, options) as got,
    ):
        assert_same_bits(wanted, got, scene, rng)


def test_the_same_choice(device, parted):
    """By the host, or by the device's own controller where there is one."""
    scene, cameras = street()
    options, schedule = SweepOptions(0.01), PruningOptions(1e-5, 12)
    with (
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, options) as wanted,
        parted(device, scene, cameras, options) as got,
    ):
        if isinstance(got, PartedRemoval):
            assert (got.steering is None) == (wanted.steering is None)
        a, b = (prune_scene(removal, schedule) for removal in (wanted, got))
    assert np.array_equal(a.order, b.order)
    assert a.kept == b.kept < len(scene)
    assert np.array_equal(a.iteration_of, b.iteration_of)


def test_gathered_on_the_device(device):
    scene, cameras = street(2)
    splats = np.arange(1, len(scene), 3)
    with (
        uploaded(device, scene) as whole,
        gathered(whole, splats) as part,
        Rasterizer(device, part) as one,
        Rasterizer(device, scene.subset(splats)) as other,
    ):
        for camera in cameras:
            assert np.array_equal(one.render(camera)[0], other.render(camera)[0])


def test_from_a_scene_on_the_device(device, parted):
    scene, cameras = street()
    with uploaded(device, scene) as whole, parted(device, scene, cameras, SweepOptions(0.0), whole) as got:
        found = got.measure()
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras, SweepOptions(0.0)) as wanted:
        effects = wanted.measure()
    assert np.array_equal(effects[0], found[0])


@pytest.mark.one_family
def test_spared_splats_stay(device):
    scene, cameras = street()
    spared = np.random.default_rng(2).random(len(scene)) < 0.3
    parts = Visibility.of(scene, cameras).clusters()
    schedule = PruningOptions(1e-2, 4)
    for memory in (None, 0):
        options = SweepOptions(0.0, memory=memory)
        with PartedRemoval(device, scene, scene, cameras, parts, options) as removal:
            freely = prune_scene(removal, schedule)
        with PartedRemoval(device, scene, scene, cameras, parts, options, spared=spared) as removal:
            pruned = prune_scene(removal, schedule)
        assert np.isin(np.flatnonzero(spared), pruned.survivors).all()
        assert not np.isin(np.flatnonzero(spared), freely.survivors).all()
        assert pruned.kept < len(scene) - 100


def test_unseen_splats_are_kept_without_a_copy_of_the_scene(device, monkeypatch):
    """And lose their directions, as those do that are set aside."""
    scene, cameras = street(6, 400)
    cameras = [camera for camera in cameras if not camera.name.startswith(("5", "along"))]
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 6}, refit=False)
    options = dataclasses.replace(options, cameras_anyway=True)
    aside = encode(scene, cameras, options, device=device)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    spared = encode(scene, cameras, options, device=device)
    assert aside.unseen is not None
    assert aside.unseen.splats > 300
    assert spared.unseen == aside.unseen
    assert spared.data == aside.data


def test_groups_are_made_only_where_they_can_be_of_use(device, monkeypatch):
    """Where few of the splats tell that a view sees more than half of them, all of them need not be looked at."""
    scene, cameras = street(2, 300)
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 2}, refit=False, compact=False)
    options = dataclasses.replace(options, cameras_anyway=True)
    grouped = []
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    monkeypatch.setattr(prune, "groups_of_large", lambda scene, run: grouped.append(scene))
    for part in (0.55, 0.45):
        monkeypatch.setattr(prune, "seen_part", lambda scene, views, part=part: part)
        encode(scene, cameras, options, device=device)
    assert len(grouped) == 1
    assert 0.2 < visibility.seen_part(*street(5, 900)) < 0.45


@pytest.mark.one_family
def test_a_whole_encode_has_the_same_bytes(device, monkeypatch):
    scene, cameras = street(5, 900)
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 6}, refit={"steps": 2})
    options = dataclasses.replace(options, cameras_anyway=True)
    whole = encode(scene, cameras, options, device=device)
    made = []

    def noting(*given):
        made.append(given[4])
        return (DrawnRemoval if device.family == "cpu" else PartedRemoval)(*given)

    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    for name in ("PartedRemoval", "DrawnRemoval"):
        monkeypatch.setattr(measured, name, noting)
    # What a GPU does is another module's matter (test_view_by_view.py).
    monkeypatch.setattr(SweepOptions, "only_by_tolerance", property(lambda options: False))
    in_parts = encode(scene, cameras, options, device=device)
    assert len(made[0]) > 2
    assert whole.data == in_parts.data
