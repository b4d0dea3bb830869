"""How many views between the training views fit, in scenes of which a view sees a part."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec.quantize import HyperParameters
from potr_cl.model import splat_groups
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.resident import ResidentScene
from potr_cl.stages.pruning.removal import Wanted, planned_sweep
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import State, Workbench
from potr_cl.stages.views_between import room_for
from potr_cl.views import visibility
from potr_cl.views.visibility import Visibility
from tests.cases.streets import street
from tests.devices import shared_device


@pytest.fixture(autouse=True)
def _large(monkeypatch):
    """The street counts as a large scene."""
    monkeypatch.setattr(splat_groups, "LARGEST", 32)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    monkeypatch.setattr(visibility, "_SAMPLED", 2)


def houses() -> tuple[Scene, list[Camera]]:
    """A street without the view along it, which sees all."""
    scene, cameras = street(10, 3000)
    return scene, [camera for camera in cameras if camera.name != "along"]


def rooms(device, memories, kept: bool = False) -> list[int]:
    """How many of the second half of the street's views fit beside the first half's, with so much memory."""
    scene, cameras = houses()
    own, more = cameras[::2], cameras[1::2]
    state = State.of(scene, own)
    found = []
    for memory in memories:
        with ResidentScene(device, scene) as on_device:
            bench = Workbench(
                HyperParameters.from_quality(0.5), device=device, memory=memory, kept=on_device if kept else None
            )
            found.append(room_for(more, state, bench))
    assert device.allocated == 0
    return found


def test_where_views_are_made_again_in_batches_all_are_added():
    _, cameras = houses()
    assert rooms(shared_device("gpu"), [0, 1 << 30], kept=True) == [len(cameras[1::2])] * 2


@pytest.mark.slow
def test_elsewhere_as_many_as_fit_with_what_each_may_draw(monkeypatch):
    """With the memory that the estimate was made for, none is made again for each measurement."""
    device = shared_device("cpu")
    scene, cameras = houses()
    own, more = cameras[::2], cameras[1::2]
    memories = [k << 20 for k in range(0, 60, 6)]
    found = rooms(device, memories)
    assert found == sorted(found)
    assert found[0] == 0
    some = int(np.flatnonzero((np.array(found) > 0) & (np.array(found) < len(more)))[0])
    views = [*own, *more[: found[some]]]
    options = SweepOptions(memory=memories[some])
    with planned_sweep(device, scene, Wanted(views, options, visibility=Visibility.of(scene, views))) as removal:
        assert removal.ready_views == len(views)
    # More than if each view needed room for the whole scene.
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1 << 30)
    assert sum(found) > sum(rooms(device, memories)) + 3
