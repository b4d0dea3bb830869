"""Antialiased scenes: what the compaction weighs their splats with, and files of them, against float64."""

from __future__ import annotations

import numpy as np
import pytest

import potr_cl
from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, Scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS, ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep import SweepOptions
from tests.cases.scenes import antialiased
from tests.reference import raster as reference
from tests.reference.scenes import ring_of_cameras, visible_scene


def small(splats: int, degree: int = 1, seed: int = 0, low_pass: float = LOW_PASS) -> Scene:
    """Splats of about a pixel, where the factor is 0.2 to 0.9."""
    return antialiased(visible_scene(splats, degree, seed), low_pass)


def test_the_compaction_weighs_each_splat_by_what_it_shows(device):
    scene, cameras = small(40, 0, seed=5), ring_of_cameras(2, size=40)
    with (
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, SweepOptions(0.0, turns=1)) as removal,
    ):
        removal.measure()
        weights = ViewWeights.from_importances(len(scene), removal.view_importances())
    dense = np.zeros((len(scene), len(cameras)))
    rows = np.repeat(np.arange(len(scene)), np.diff(weights.offsets))
    dense[rows, weights.views] = weights.weights
    for number, view in enumerate(cameras):
        projected = reference.project(scene, view, INRIA)
        projected.colour = np.eye(len(projected.index))
        true = np.zeros(len(scene))
        true[projected.index] = reference.composite(projected, (40, 40), INRIA, (0.0,)).image.mean(axis=(0, 1))
        assert np.abs(dense[:, number] / REFERENCE_PIXELS - true).max() < 1e-5 * true.max()


@pytest.mark.one_family
@pytest.mark.parametrize(("preset", "low_pass"), [("paper", LOW_PASS), ("best", MIP_SPLATTING_LOW_PASS)])
def test_a_file_keeps_how_its_scene_is_rendered(device, preset, low_pass):
    """Through pruning, compaction, re-fit and coder; and the file is judged by antialiased pictures."""
    scene, cameras = small(300, 2, low_pass=low_pass), ring_of_cameras(6, size=40)
    options = EncodeOptions.for_preset(preset, q=0.7, prune={"iterations": 4})
    data = b"".join(encode(scene, cameras, options, device=device).pieces)
    back = potr_cl.codec.decoder.open_file(data).scene()
    assert (back.antialiased, back.low_pass) == (True, low_pass)
    assert 0 < len(back) <= len(scene)
    keyword = b"".join(encode(scene.rendered(False), cameras, options, device=device, antialiased=True).pieces)
    assert (keyword == data) == (low_pass == LOW_PASS)
    errors = []
    for candidate in (back, back.rendered(False)):
        pictures = [reference.render(each, view, INRIA).image for view in cameras[:2] for each in (scene, candidate)]
        errors.append(np.mean(np.square(np.subtract(pictures[0::2], pictures[1::2]))))
    assert errors[0] < 0.2 * errors[1]
