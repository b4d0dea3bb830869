"""Quantised geometry: what it says a decoder will see is what the decoder sees."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.geometry import quantise_geometry
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import train_views
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.reference.scenes import random_scene, ring_of_cameras


def some_scene(kind):
    scene = random_scene(900, 1, seed=3)
    if kind == "coincident":
        return scene.subset(np.r_[np.arange(900), np.zeros(30, int), 5, 5])
    if kind == "one splat":
        return scene.subset(np.arange(1))
    if kind == "balls":
        return dataclasses.replace(scene, log_scales=np.full_like(scene.log_scales, -6))
    return scene


@pytest.mark.parametrize("kind", ["any", "coincident", "one splat", "balls"])
@pytest.mark.parametrize("preset", ["paper", "best"])
@pytest.mark.parametrize("cameras", [True, False])
def test_decoded_before_it_is_coded(kind, preset, cameras):
    scene = some_scene(kind)
    parameters = EncodeOptions(preset=preset, q=0.3).parameters
    views = train_views(ring_of_cameras(8)) if cameras else []
    with thread_pool(3) as pool:
        geometry = quantise_geometry(scene, parameters, views, pool.map)
    coded = code_scene(scene, parameters, views, entropy=EntropyCoder("zstd", 1))
    assert np.array_equal(coded.order, geometry.order)
    seen, expected = geometry.decoded(scene.sh), decode(b"".join(coded.pieces))
    for name in ("means", "log_scales", "quaternions", "opacity_logits"):
        assert np.array_equal(getattr(seen, name)[geometry.order], getattr(expected, name)), name
    assert seen.sh is scene.sh


@pytest.mark.parametrize("entropy", ["context", "zstd"])
def test_a_file_of_geometry_that_was_there_is_the_same_file(entropy):
    scene = random_scene(700, 2)
    parameters, coder = EncodeOptions().parameters, EntropyCoder(entropy)
    geometry = quantise_geometry(scene, parameters, [])
    files = {
        b"".join(code_scene(scene, parameters, entropy=coder, geometry=known).pieces) for known in (None, geometry)
    }
    assert len(files) == 1
