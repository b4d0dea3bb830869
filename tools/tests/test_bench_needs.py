"""What a scene does not need is not done: the costs that do not depend on the machine."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.bench.needs import Needs, looking_away, more


@pytest.fixture(scope="module")
def needs(plush_excerpt, plush_excerpt_cameras):
    views = [camera for camera in plush_excerpt_cameras if camera.split == "train"][:2]
    return Needs(plush_excerpt, views, Device(), repeats=1, iterations=3)


@pytest.mark.slow
def test_what_is_skipped_costs_less(needs):
    lines = {}
    for line in needs.lines():
        lines.setdefault(line.skipped, []).append(line)
        assert all(cost > 0 for cost in line.costs)
    sweeps = [line.costs for line in lines["unchanged and hardly changed tiles"]]
    assert all(lean < full for lean, full in sweeps)
    settled = lines["iterations with nothing left to decide"][0].costs
    assert settled[0] < settled[1]
    sizes = lines["bands that are all zero"][0].costs
    assert sizes[0] == sizes[1]
    grey, coloured = lines["channels that are all zero"][0].costs
    assert grey < 0.8 * coloured


def test_views_that_look_away_see_nothing(needs):
    with Rasterizer(needs.device, needs.scene) as rasterizer:
        for camera in needs.views:
            image, transmittance = rasterizer.render(looking_away(camera))
            assert not image.any()
            assert (transmittance == 1).all()
            assert np.allclose(looking_away(camera).centre, camera.centre)


def test_splats_that_nobody_sees_are_in_no_list(needs):
    twice = more(needs.scene, opacity_logits=np.full(len(needs.scene), -6, np.float32))
    assert len(twice) == 2 * len(needs.scene)
    counts = []
    for scene in (needs.scene, twice):
        with Rasterizer(needs.device, scene) as rasterizer:
            with rasterizer.prepare(needs.views[0]) as view:
                counts.append(view.intersection_count)
            with RemovalSweep(rasterizer, needs.views, SweepOptions()) as removal:
                assert (removal.measure()[1][len(needs.scene) :] == 0).all()
    assert counts[0] == counts[1] > 0
