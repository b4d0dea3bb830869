"""Quantised geometry: what it says a decoder will see is what the decoder sees."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec import octree
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.geometry import quantise_geometry
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import train_views
from potr_cl.pipeline.options import EncodeOptions
from tests.reference.scenes import random_scene, ring_of_cameras


def some_scene(kind):
    scene = random_scene(900, 1, seed=3)
    if kind == "coincident":
        return scene.subset(np.r_[np.arange(900), np.zeros(30, int), 5, 5])
    if kind == "one splat":
        return scene.subset(np.arange(1))
    if kind == "balls":
        return dataclasses.replace(scene, log_scales=np.full_like(scene.log_scales, -6))
    return scene


SHAPE = ("log_scales", "quaternions", "opacity_logits")
KINDS = pytest.mark.parametrize("kind", ["any", "coincident", "one splat", "balls"])
PRESETS = pytest.mark.parametrize("preset", ["paper", "best"])


@KINDS
@PRESETS
@pytest.mark.parametrize("cameras", [True, False])
def test_decoded_before_it_is_coded(kind, preset, cameras):
    scene = some_scene(kind)
    parameters = EncodeOptions(preset=preset, q=0.3).parameters
    views = train_views(ring_of_cameras(8)) if cameras else []
    with thread_pool(3) as pool:
        geometry = quantise_geometry(scene, parameters, views, pool.map)
    coder = EntropyCoder("bundles" if preset == "best" else "zstd", 1)
    coded, again = (code_scene(scene, parameters, views, entropy=coder, geometry=known) for known in (None, geometry))
    assert b"".join(again.pieces) == b"".join(coded.pieces)
    assert np.array_equal(coded.order, geometry.order)
    seen, expected = geometry.decoded(scene.sh), decode(b"".join(coded.pieces))
    for name in ("means", *SHAPE):
        assert np.array_equal(getattr(seen, name)[geometry.order], getattr(expected, name)), name
    assert seen.sh is scene.sh


@KINDS
def test_centres_move_while_the_rest_stays_rounded_and_shapes_after_them(kind):
    scene = some_scene(kind)
    parameters = EncodeOptions(q=0.3).parameters
    views = train_views(ring_of_cameras(8))
    first = quantise_geometry(scene, parameters, views)
    decoded = first.decoded(scene.sh)
    rng = np.random.default_rng(0)
    means = scene.means + rng.normal(0, 0.01, scene.means.shape).astype(np.float32)
    second = first.with_centres_of(means, views)
    seen = second.decoded(scene.sh)
    for name in SHAPE:
        assert np.array_equal(getattr(seen, name), getattr(decoded, name)), name
    at_once = quantise_geometry(dataclasses.replace(scene, means=means), parameters, views).decoded(scene.sh)
    errors = [np.linalg.norm(each.means - means, axis=1) for each in (seen, at_once)]
    assert errors[0].max() == pytest.approx(errors[1].max(), rel=0.1)
    changed = dataclasses.replace(
        scene, opacity_logits=scene.opacity_logits - 1, quaternions=scene.quaternions[::-1].copy()
    )
    third = second.with_shapes_of(changed).decoded(scene.sh)
    expected = quantise_geometry(changed, parameters, views).decoded(scene.sh)
    for name in SHAPE:
        assert np.array_equal(getattr(third, name), getattr(expected, name)), name
    assert np.array_equal(third.means, seen.means)


# Splats far away ------------------------------------------------------------------------------------------------------


def with_splats_at(*places, seed=3):
    scene = random_scene(300, 0, seed=seed)
    scene.means[: len(places)] = places
    return scene


def errors_of_the_others(scene, parameters, far):
    geometry = quantise_geometry(scene, parameters, ())
    decoded = geometry.decoded(scene.sh).means.astype(np.float64)
    return np.linalg.norm(decoded - scene.means, axis=1)[far:].max(), geometry.parameters.gamma


@PRESETS
@pytest.mark.parametrize(
    "places",
    [
        [(1e14, 0, 0)],
        [(0, -1e15, 3)],
        [(3e38, 3e38, -3e38)],
        [(1e14, 0, 0), (-1e20, 0, 0)],
        [(1e14 + k * 1e9, 0, 0) for k in range(100)],
    ],
    ids=["one", "one below", "the largest", "two", "a third of all"],
)
def test_splats_too_far_away_are_named(places, preset):
    """They would collapse all others into coarse cells."""
    parameters = HyperParameters.from_quality(0.9, preset)
    with pytest.raises(DataError, match="so far from the others") as caught:
        quantise_geometry(with_splats_at(*places), parameters, ())
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("the splat at (" if len(places) == 1 else f"{len(places)} splats, such as those at (")
    assert message.count("e+") >= min(len(places), 3)  # the far ones are named, and no other


@PRESETS
@pytest.mark.parametrize("distance", [1e3, 1e9, 1e10, 1e11, 1e12, 1e13, 1e30])
def test_the_others_are_as_exact_as_without_a_far_splat_or_it_is_refused(preset, distance):
    parameters = HyperParameters.from_quality(0.9, preset)
    scene = with_splats_at((distance, -distance, 1))
    rounding = np.abs(scene.means[1:]).max() * 2.0**-23  # of single precision, of what lies within the tolerance
    alone, gamma = errors_of_the_others(scene.subset(np.arange(1, 300)), parameters, 0)
    assert alone <= gamma + rounding
    try:
        error, gamma = errors_of_the_others(scene, parameters, 1)
    except DataError:
        assert distance > 1e9  # levels enough
        return
    assert distance < 1e13
    assert error <= gamma + rounding


@PRESETS
def test_a_splat_in_the_eye_of_a_camera_is_no_reason_to_refuse(preset):
    """Its tolerance is nothing, and no level is fine enough; yet no splat is out of place."""
    scene = with_splats_at((0, 0, 0), (40, 0, 0))
    camera = dataclasses.replace(ring_of_cameras(1)[0], translation=np.zeros(3), split="train")
    geometry = quantise_geometry(scene, HyperParameters.from_quality(0.9, preset), [camera])
    assert np.abs(geometry.decoded(scene.sh).means[0]).max() < 1e-6


def test_a_deep_octree_is_written_once(monkeypatch):
    """What is looked at to see that all centres are exact enough is what the file gets."""
    scene = some_scene("any")
    scene.means[0] = 1e11
    written = []
    begin = octree.begin

    def noting(*args: object) -> octree.Begun:
        begun = begin(*args)  # type: ignore[arg-type]
        return dataclasses.replace(begun, streams=lambda: written.append(begun) or begun.streams())

    monkeypatch.setattr(octree, "begin", noting)
    geometry = quantise_geometry(scene, EncodeOptions(q=0.3).parameters, [])
    assert geometry.tree.depth > 44
    assert np.array_equal(octree.parse(geometry.tree, len(scene)), geometry.centres)
    assert len(written) == 1
