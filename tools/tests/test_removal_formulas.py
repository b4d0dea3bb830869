"""The paper's formula of removal effects, which the package does not use, gives what the package's gives."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.reference.scenes import ring_of_cameras, visible_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.study.removal_formulas import devices


def measure(device, scene, cameras, background):
    """Effects and importances of the whole scene, and of what is left when every third splat is gone."""
    with (
        Rasterizer(device, scene, background=background) as rasterizer,
        RemovalSweep(rasterizer, cameras, SweepOptions(0)) as removal,
    ):
        whole = np.stack(removal.measure())
        gone = np.arange(0, len(scene), 3)
        removal.remove(gone)
        rest = np.delete(np.stack(removal.measure()), gone, axis=1)
    assert device.allocated == 0
    return whole, rest


def agree(family, scene, cameras, background=(0.0, 0.0, 0.0)):
    mine, theirs = (measure(device, scene, cameras, background) for device in devices(family=family))
    assert not np.array_equal(mine[0], theirs[0])  # two kernels, not one
    for a, b in zip(mine, theirs, strict=True):
        assert (np.abs(a - b).max(axis=1) < 1e-5 * np.abs(a).max(axis=1)).all()


@pytest.mark.parametrize("family", ["cpu", "gpu"])
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.3, 0.0)])
def test_prefix_sums_agree_with_back_to_front(family, background):
    agree(family, visible_scene(60, 1), ring_of_cameras(2, size=40), background)


@pytest.mark.parametrize("family", ["cpu", "gpu"])
def test_prefix_sums_agree_where_pixels_end_early(family):
    agree(family, visible_scene(600, 0).subset(np.repeat(np.arange(600), 4)), ring_of_cameras(2, size=40))


@pytest.mark.parametrize(("splats", "segments"), [(3000, 2), (25000, 17)])
def test_prefix_sums_agree_in_lists_of_many_segments(splats, segments):
    """CPU kernels walk a list 1024 splats at a time, and remember 16 places in it at the most."""
    scene = visible_scene(splats, 0)
    scene.log_scales[:] = -4.5
    scene.opacity_logits[:] = -4.5
    camera = ring_of_cameras(1, size=16)[0]
    agree("cpu", scene, [camera])
    device = devices(family="cpu")[0]
    rasterizer = Rasterizer(device, scene)
    assert rasterizer.prepare(camera).intersection_count > 1024 * segments
    assert rasterizer.render(camera)[1].max() > 1e-4  # pixels go on to the end
