"""What a device says is seen is seen, what it says is not is not, and it says so of nearly all."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model.splat_groups import unseen_splats
from potr_cl.raster.scene_buffers import uploaded
from potr_cl.stages.stage import State
from potr_cl.stages.unseen import find_unseen
from potr_cl.views.reached import Seen, surely_seen
from tests.reference.scenes import random_scene


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


@pytest.mark.parametrize(
    ("by", "found", "not_found"), [((0, 0, 0), 0.99, 0.99), ((300, -200, 100), 0.7, 0.6), ((1e5, 0, 1e5), 0.0, 0.0)]
)
def test_it_agrees_with_double_precision(device, plush_excerpt, narrow, by, found, not_found):
    scene, views = moved(plush_excerpt, narrow, by)
    seen = ~unseen_splats(scene, views)
    assert 0.02 * len(scene) < seen.sum() < len(scene)
    with uploaded(device, scene) as there:
        quick = surely_seen(there, views)
        assert seen[quick == Seen.YES].all()
        assert not seen[quick == Seen.NO].any()
        assert np.count_nonzero(quick == Seen.YES) >= found * seen.sum()
        assert np.count_nonzero(quick == Seen.NO) >= not_found * (~seen).sum()
        one = surely_seen(there, views[:1])
        assert not (one == Seen.YES)[unseen_splats(scene, views[:1])].any()


def test_splats_beyond_what_single_precision_holds_are_left_undecided(device, narrow):
    scene = random_scene(3, 0, seed=1)
    log_scales, means = scene.log_scales.copy(), np.full((3, 3), 10, np.float32)
    log_scales[0], means[1], means[2] = 60, 3e38, -1e30
    scene = dataclasses.replace(scene, log_scales=log_scales, means=means)
    with uploaded(device, scene) as there:
        found = surely_seen(there, narrow)
    unseen = unseen_splats(scene, narrow)
    assert not unseen[found == Seen.YES].any()
    assert unseen[found == Seen.NO].all()
    assert found[0] != Seen.NO
    assert found[1] != Seen.NO


def test_the_same_splats_are_unseen(device, plush_excerpt, narrow):
    state = State.of(plush_excerpt, narrow)
    wanted, area = find_unseen(state)
    with uploaded(device, plush_excerpt) as there:
        found, its_area = find_unseen(state, surely_seen=lambda views: surely_seen(there, views))
    assert np.array_equal(found, wanted)
    assert 0 < its_area() == area() < 1
