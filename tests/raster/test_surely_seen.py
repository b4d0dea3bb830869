"""What a device says is seen is seen, and it says so of nearly all that are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model.unseen import unseen_splats
from potr_cl.raster.scene_buffers import uploaded
from potr_cl.raster.surely_seen import surely_seen
from potr_cl.stages.pruning.unseen import find_unseen
from potr_cl.stages.stage import State
from tests.devices import KERNELS, open_device


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0


@pytest.fixture
def narrow(plush_excerpt_cameras):
    """Views that miss many splats, of different sizes, one turned away."""
    views = [dataclasses.replace(c, fx=30 * c.fx, fy=20 * c.fy) for c in plush_excerpt_cameras[:5]]
    return [*views, dataclasses.replace(views[0], rotation=np.diag([1, -1, -1]) @ views[0].rotation)]


def moved(scene, cameras, by):
    """The same far away from the origin, where single precision has few digits left."""
    shift = np.asarray(by, np.float64)
    views = [dataclasses.replace(c, translation=c.translation - c.rotation @ shift) for c in cameras]
    return dataclasses.replace(scene, means=(scene.means + shift).astype(np.float32)), views


@pytest.mark.parametrize(("by", "found"), [((0, 0, 0), 0.99), ((300, -200, 100), 0.7), ((1e5, 0, 1e5), 0.0)])
def test_it_agrees_with_double_precision(device, plush_excerpt, narrow, by, found):
    scene, views = moved(plush_excerpt, narrow, by)
    seen = ~unseen_splats(scene, views)
    assert 0.02 * len(scene) < seen.sum() < len(scene)
    with uploaded(device, scene) as there:
        quick = surely_seen(there, views)
        assert not quick[~seen].any()
        assert quick.sum() >= found * seen.sum()
        assert not surely_seen(there, views[:1])[unseen_splats(scene, views[:1])].any()


def test_the_same_splats_are_unseen(device, plush_excerpt, narrow):
    state = State.of(plush_excerpt, narrow)
    wanted, area = find_unseen(state)
    with uploaded(device, plush_excerpt) as there:
        found, its_area = find_unseen(state, surely_seen=lambda views: surely_seen(there, views))
    assert np.array_equal(found, wanted)
    assert its_area == area
