"""Removal effects view by view on a GPU: the same bits as with all splats for all views."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model import splat_groups
from potr_cl.opencl.memory import Memory
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.picked_splats import PickedSplats, Picker, Picks
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.raster.scene_buffers import uploaded
from potr_cl.stages.pruning import measured
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.pruning.view_by_view import ViewByView
from potr_cl.stages.pruning.visible_parts import first_totals
from potr_cl.views import visibility
from potr_cl.views.visibility import Visibility
from tests.cases.streets import street
from tests.cases.sweeps import assert_same_bits
from tests.devices import KERNELS, open_device


@pytest.fixture(scope="module", params=[kernels for kernels in KERNELS if "gpu" in str(kernels)])
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a sweep did not give all its memory back"


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)


#: Bytes that some of the street's views fit, and bytes that hardly more than the pictures of all fit.
SOME, TARGETS = 1_600_000, 1_100_000


@pytest.mark.parametrize(
    ("memory", "tolerance"),
    [(None, 0.0), (None, 0.05), (SOME, 0.0), (TARGETS, 0.0), (0, 0.0)],
    ids=["all fits", "all fits, tolerance", "some fits", "targets fit", "nothing fits"],
)
def test_the_same_bits(device, memory, tolerance):
    """While splats go and colours change. Which views are kept is another matter: so none may be skipped there."""
    scene, cameras = street()
    options = SweepOptions(tolerance, memory=memory)
    rng = np.random.default_rng(1)
    with (
        uploaded(device, scene) as whole,
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, dataclasses.replace(options, memory=None)) as wanted,
        ViewByView(device, whole, cameras, Visibility.of(scene, cameras, INRIA.near), options) as got,
    ):
        assert memory is not None or got.kept_views == len(cameras)
        assert memory != SOME or 2 < got.kept_views < len(cameras) - 2
        assert memory != 0 or got.kept_views == 0
        assert_same_bits(wanted, got, scene, rng)


def test_the_same_choice(device):
    scene, cameras = street()
    options, schedule = SweepOptions(0.01), PruningOptions(1e-5, 12)
    with (
        uploaded(device, scene) as whole,
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, options) as wanted,
        ViewByView(device, whole, cameras, Visibility.of(scene, cameras, INRIA.near), options) as got,
    ):
        a, b = (prune_scene(removal, schedule) for removal in (wanted, got))
    assert np.array_equal(a.order, b.order)
    assert a.kept == b.kept < len(scene)
    assert np.array_equal(a.iteration_of, b.iteration_of)


def test_removal_before_anything_was_measured(device):
    """The targets show the splats that are gone."""
    scene, cameras = street()
    gone = np.arange(0, len(scene), 3)
    options = SweepOptions(0.0)
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras, options) as sweep:
        sweep.measure()
        sweep.remove(gone)
        wanted = sweep.measure()
    sights = Visibility.of(scene, cameras, INRIA.near)
    for memory in (None, 0):
        with uploaded(device, scene) as whole:
            given = dataclasses.replace(options, memory=memory)
            with ViewByView(device, whole, cameras, sights, given) as got:
                got.remove(gone)
                found = got.measure()
        assert np.array_equal(wanted[0][np.arange(1, len(scene), 3)], found[0][np.arange(1, len(scene), 3)])


@pytest.mark.parametrize("memory", [None, 0])
def test_a_view_in_which_nothing_is_drawn(device, memory):
    """Its splats are too faint: there is not one intersection of a splat and a tile."""
    scene, cameras = street(2)
    faint = dataclasses.replace(scene, opacity_logits=np.full(len(scene), -30, np.float32))
    sights = Visibility.of(faint, cameras, INRIA.near)
    with (
        uploaded(device, faint) as whole,
        ViewByView(device, whole, cameras, sights, SweepOptions(0.0, memory=memory)) as removal,
    ):
        effects, importances = removal.measure()
    assert not effects.any()
    assert not importances.any()


def test_views_that_are_not_kept_wait_until_they_have_lost_enough(device):
    scene, cameras = street()
    sights = Visibility.of(scene, cameras, INRIA.near)
    with (
        uploaded(device, scene) as whole,
        ViewByView(device, whole, cameras, sights, SweepOptions(0.06, memory=0)) as waiting,
        ViewByView(device, whole, cameras, sights, SweepOptions(0.0, memory=0)) as eager,
    ):
        (_, importances), first = eager.measure(), waiting.measure()
        order = np.argsort(importances)
        covered = np.cumsum(importances[order])
        little, much = order[covered < 0.02], order[covered < 0.06]
        assert 0 < len(little) < len(much)
        for removal in (eager, waiting):
            removal.remove(little)
        after = waiting.measure()
        assert np.array_equal(after[0], first[0])  # nothing was measured
        assert not np.array_equal(eager.measure()[0][much], first[0][much])
        for removal in (eager, waiting):
            removal.remove(np.setdiff1d(much, little))
        left = np.setdiff1d(order, much)
        assert np.array_equal(waiting.measure()[0][left], eager.measure()[0][left])


@pytest.mark.parametrize("memory", [None, 0])
def test_spared_splats_stay(device, memory):
    scene, cameras = street()
    spared = np.random.default_rng(2).random(len(scene)) < 0.3
    sights, options = Visibility.of(scene, cameras, INRIA.near), SweepOptions(0.0, memory=memory)
    with uploaded(device, scene) as whole:
        kept = []
        for some in (None, spared):
            first = first_totals(len(scene), some)
            with ViewByView(device, whole, cameras, sights, options, first_totals=first) as removal:
                kept.append(prune_scene(removal, PruningOptions(1e-2, 4)).survivors)
    assert not np.isin(np.flatnonzero(spared), kept[0]).all()
    assert np.isin(np.flatnonzero(spared), kept[1]).all()
    assert len(kept[1]) < len(scene) - 100


def test_picked_splats_are_drawn_as_a_scene_of_their_own(device):
    scene, cameras = street(2)
    splats = np.arange(1, len(scene), 3)
    with uploaded(device, scene) as whole, Memory(device) as memory:
        numbers = memory.upload(splats.astype(np.uint32), "some splats")
        with (
            Rasterizer(device, PickedSplats(whole, numbers, len(splats))) as one,
            Rasterizer(device, scene.subset(splats)) as other,
        ):
            for camera in cameras:
                assert np.array_equal(one.render(camera)[0], other.render(camera)[0])


@pytest.mark.parametrize("splats", [1, 4096, 10_000])
def test_the_numbers_of_some_groups(device, splats):
    rng = np.random.default_rng(splats)
    groups = rng.integers(0, 40, splats).astype(np.uint32)
    wanted = rng.random(40) < 0.4
    wanted[groups[0]] = True
    with Picker(device, groups) as picker, Memory(device) as memory:
        numbers, count = picker.pick(memory, wanted)
        expected = np.flatnonzero(wanted[groups])
        assert count == len(expected)
        assert np.array_equal(device.download(numbers, (count,), np.uint32), expected)


def test_the_numbers_of_several_choices_of_groups(device):
    rng = np.random.default_rng(7)
    groups = rng.integers(0, 40, 10_000).astype(np.uint32)
    wanted = rng.random((5, 40)) < np.array([0.0, 0.1, 0.5, 0.9, 1.0])[:, None]
    with Picker(device, groups) as picker, Memory(device) as memory:
        picks = Picks(memory, picker, wanted)
        for choice in (3, 0, 4, 1, 2):
            expected = np.flatnonzero(wanted[choice][groups])
            assert picks.counts[choice] == len(expected)
            numbers = picks.numbers(memory, choice)
            assert np.array_equal(device.download(numbers, (len(expected),), np.uint32), expected)


def test_a_whole_encode_has_the_same_bytes(device, monkeypatch):
    scene, cameras = street(5, 900)
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 6}, refit={"steps": 2})
    options = dataclasses.replace(options, cameras_anyway=True)
    whole = encode(scene, cameras, options, device=device)
    made = []

    class Noting(ViewByView):
        def __init__(self, *given, **named):
            super().__init__(*given, **named)
            made.append(self.kept_views)

    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    monkeypatch.setattr(measured, "ViewByView", Noting)
    by_view = encode(scene, cameras, options, device=device)
    assert made == [len(cameras)]
    assert whole.data == by_view.data
