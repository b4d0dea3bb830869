"""The guard: what no view has resolved is found, and no stage touches it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera, resized, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run, Stopwatch
from potr_cl.placement.rays import unresolved
from potr_cl.placement.virtual import place_cameras
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.code import Code
from potr_cl.stages.pruning.controller import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.stage import State
from tests.cases.surfaces import box, sphere
from tests.reference.captures import looking
from tests.reference.surfaces import together

#: Splats of a room.
_EACH = 4000


def two_rooms() -> Scene:
    """One beside the other, 20 apart, with colours of degree 1."""
    first, second = box(_EACH, (3, 4, 1.5), 0.2), box(_EACH, (3, 4, 1.5), 0.2, seed=1)
    scene = together(first, dataclasses.replace(second, means=second.means + np.array([20, 0, 0], np.float32)))
    sh = np.random.default_rng(0).normal(0, 0.3, (len(scene), 4, 3))
    return dataclasses.replace(scene, sh=sh.astype(np.float32))


SCENE = two_rooms()


def in_the_first() -> list[Camera]:
    """Views of all the first room from its middle, in pairs."""
    sides = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    views = []
    for turn in range(2):
        for number, side in enumerate((*sides, *corners)):
            centre = np.array([0.0, 0.0, 0.05 * turn])
            view = looking(centre, np.array(side, float), (0.1, 0.2, 1), f"{turn}{number}", wide=1.2)
            views.append(resized(view, 90, 60))
    return views


VIEWS = in_the_first()


@pytest.fixture(scope="module")
def device():
    """Of any family: what is new here are rays, which both compute alike."""
    return Device()


@pytest.fixture(scope="module")
def found(device):
    """What no view has resolved."""
    return unresolved(device, SCENE, VIEWS)


def test_the_room_that_nobody_looked_into_is_unresolved(found):
    assert found[_EACH:].all()
    assert np.mean(found[:_EACH]) < 0.3, "but what is between the pictures"


def kept(device: Device, preset: str = "best", **prune) -> State:
    options = EncodeOptions.for_preset(preset, prune={"iterations": 4} | prune, between={"views": 0})
    names = [type(stage) for stage in options.stages if not isinstance(stage, Code)]
    return Run(dataclasses.replace(options, q=0.1), Stopwatch(), device).stages(State.of(SCENE, VIEWS), names)


@pytest.mark.parametrize("preset", ["best", pytest.param("paper", marks=pytest.mark.slow)])
def test_no_stage_touches_what_no_view_resolved(device, found, preset):
    state = kept(device, preset, unseen="protect", delta_mse_max=1e-5)
    assert np.isin(np.flatnonzero(found), state.survivors).all()
    rows = np.flatnonzero(found[state.survivors])
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        assert np.array_equal(getattr(state.scene, name)[rows], getattr(SCENE, name)[found]), name
    assert len(state.survivors) < len(SCENE), "others go"
    assert state.results.unresolved.splats == state.results.unseen.splats == np.count_nonzero(found)


@pytest.mark.slow
def test_without_the_guard_they_are_lost(device):
    dropped = kept(device, unseen="drop")
    assert np.count_nonzero(dropped.survivors >= _EACH) < 50
    plain = kept(device, unseen="keep")
    assert plain.results.unresolved is None, "given cameras say where people look"
    assert np.count_nonzero(plain.survivors >= _EACH) < _EACH / 2


@pytest.mark.slow
def test_small_units_do_not_keep_everything(device):
    ball = sphere(8000, 2.0, 0.05)
    small = dataclasses.replace(
        ball, means=ball.means * np.float32(1e-4), log_scales=ball.log_scales + np.float32(np.log(1e-4))
    )
    assert np.mean(unresolved(device, small, train_views(place_cameras(small, 100, 300, device=device)))) < 0.2


def test_fewer_splats_than_must_stay_are_refused(device):
    with pytest.raises(UsageError, match="that no view shows from near enough: keep more"):
        kept(device, unseen="protect", count=100)


@pytest.mark.slow
def test_a_file_holds_what_was_kept(device):
    options = EncodeOptions.for_preset("best", q=0.5, prune={"iterations": 4, "unseen": "protect"}, between=False)
    encoded = encode(SCENE, VIEWS, options, device=device)
    second = encoded.order >= _EACH
    assert np.count_nonzero(second) == _EACH
    assert np.sqrt(np.mean((encoded.scene.sh[second] - SCENE.sh[encoded.order[second]]) ** 2)) < 0.1
    assert "from near enough to judge them: kept as they are" in str(encoded.unseen)


@pytest.mark.parametrize("count", [None, _EACH + 500])
def test_spared_splats_stay_whoever_decides(device, count):
    spared = np.arange(len(SCENE)) % 3 == 0
    with Rasterizer(device, SCENE) as rasterizer, RemovalSweep(rasterizer, VIEWS) as removal:
        left = prune_scene(removal, PruningOptions(1e-3, 4, count=count), spared=spared).survivors
    assert np.isin(np.flatnonzero(spared), left).all()
    assert len(left) < len(SCENE)
    if count is not None:
        assert len(left) == count
