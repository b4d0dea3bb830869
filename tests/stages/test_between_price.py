"""What a splat may cost in scenes of which a view shows a part."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import HyperParameters
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.given_views import GivenViews
from potr_cl.model.scene import Scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.target import Target
from tests.cases.judging import psnr

#: So far apart that no copy's views show another one, in world units.
APART = 200.0


def row(scene: Scene, cameras: Sequence[Camera], copies: int) -> tuple[Scene, list[Camera]]:
    """Copies of a scene beside each other, each with its own views."""
    places = [np.array([APART * copy, 0, 0]) for copy in range(copies)]
    every = scene.subset(np.tile(np.arange(len(scene)), copies))
    means = every.means + np.repeat(places, len(scene), axis=0).astype(np.float32)
    views = [
        dataclasses.replace(view, name=f"{copy}_{view.name}", translation=view.translation - view.rotation @ place)
        for copy, place in enumerate(places)
        for view in cameras
    ]
    return dataclasses.replace(every, means=means), views


def encoded(device, scene, cameras, preset="best", **between) -> Encoded:
    options = EncodeOptions.for_preset(
        preset, cameras_anyway=True, prune={"iterations": 8}, refit=False, between={"views": 0, **between}
    )
    return encode(scene, cameras, options, device=device)


@pytest.fixture(scope="module")
def twelve(plush_excerpt, plush_excerpt_cameras):
    """Copies of the excerpt, and the views of all of them."""
    return row(plush_excerpt, train_views(plush_excerpt_cameras), 12)


@pytest.fixture(scope="module")
def weighed(usual_device, twelve):
    """What they are encoded to."""
    return encoded(usual_device, *twelve)


def test_the_part_of_the_views_that_shows_a_splat(plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    part = GivenViews(plush_excerpt, given).part_of_views()
    assert part is not None
    assert 0.6 < part <= 1
    assert GivenViews(plush_excerpt, given[:1] * 5).part_of_views() == pytest.approx(1)
    for copies in (2, 12):
        found = GivenViews(*row(plush_excerpt, given, copies)).part_of_views()
        assert found == pytest.approx(part / copies, rel=0.05)


def test_a_view_from_afar_counts_little(plush_excerpt, plush_excerpt_cameras):
    near = train_views(plush_excerpt_cameras)[0]
    middle = plush_excerpt.means.mean(axis=0)
    away = middle + 20 * (near.centre - middle)
    far = dataclasses.replace(near, name="far", translation=-near.rotation @ away)
    assert GivenViews(plush_excerpt, [near, far]).part_of_views() == pytest.approx(0.5, abs=0.02)
    # Unless its picture is as narrow.
    same = dataclasses.replace(far, fx=20 * near.fx, fy=20 * near.fy)
    assert GivenViews(plush_excerpt, [near, same]).part_of_views() > 0.9


def test_views_that_show_nothing_tell_nothing(plush_excerpt, plush_excerpt_cameras):
    view = train_views(plush_excerpt_cameras)[0]
    away = dataclasses.replace(view, translation=view.translation - np.array([0, 0, 1e4]))
    assert GivenViews(plush_excerpt, [away, away]).part_of_views() is None


@pytest.mark.slow
def test_copies_keep_about_as_many_splats_as_one(usual_device, plush_excerpt, plush_excerpt_cameras, twelve, weighed):
    alone = len(encoded(usual_device, plush_excerpt, train_views(plush_excerpt_cameras)).order)
    scene, cameras = twelve
    before = encoded(usual_device, scene, cameras, weigh=False)
    lost_before, lost = (alone - len(each.order) / 12 for each in (before, weighed))
    assert lost_before > 0.1 * alone, (alone, lost_before, lost)
    assert lost < 0.5 * lost_before, (alone, lost_before, lost)
    near, far = (psnr(usual_device, scene, decode(each.data), cameras[::5]) for each in (weighed, before))
    assert near > far + 0.3


def test_the_thresholds_follow_the_part_of_the_views_that_show_a_splat(weighed):
    asked = HyperParameters.from_quality(0.5, "best")
    taken = weighed.parameters
    part = taken.delta_mse_max / asked.delta_mse_max
    assert 1 / 12 <= part < 1 / 3
    assert taken.drop == pytest.approx(part * asked.drop)
    assert dataclasses.replace(taken, delta_mse_max=asked.delta_mse_max, drop=asked.drop) == asked


@pytest.mark.slow
def test_scenes_that_are_seen_whole_and_the_papers_preset_stay_as_they_are(
    usual_device, plush_excerpt, plush_excerpt_cameras, twelve
):
    given = train_views(plush_excerpt_cameras)
    files = {encoded(usual_device, plush_excerpt, given, weigh=weigh).data for weigh in (True, False)}
    assert len(files) == 1
    scene, cameras = twelve
    options = EncodeOptions.for_preset("paper", cameras_anyway=True, prune={"iterations": 2})
    paper = encode(scene, cameras, options, device=usual_device)
    assert paper.parameters == HyperParameters.from_quality(0.5, "paper")


@pytest.mark.slow
def test_a_search_and_an_encode_with_what_it_found_are_the_same(usual_device, plush_excerpt, plush_excerpt_cameras):
    scene, cameras = row(plush_excerpt, train_views(plush_excerpt_cameras), 4)
    options = EncodeOptions.for_preset("best", cameras_anyway=True, prune={"iterations": 4}, refit={"steps": 2})
    options = options.changed(between={"views": 0})
    found = encode_to_target(scene, cameras, Target(max_bytes=100_000), options, device=usual_device)
    again = encode(scene, cameras, found.options, device=usual_device)
    assert again.parameters.delta_mse_max < HyperParameters.from_quality(found.options.q, "best").delta_mse_max
    assert again.data == found.encoded.data
