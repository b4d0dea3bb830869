"""Some splats of a file, decoded while all go elsewhere: the bits that they have in the whole scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import PotrFile
from potr_cl.codec.destination import SceneArrays
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sampled import Both, Sampled
from potr_cl.model.agreement import judge_cameras
from potr_cl.model.scene import Scene
from potr_cl.model.sightings import looked_at
from tests.reference.scenes import random_scene, tilted_camera

GOLDEN = sorted((Path(__file__).parents[1] / "data").glob("golden_v[123]*.potr"))


def assert_same_bits(one: Scene, other: Scene) -> None:
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        a, b = (np.ascontiguousarray(getattr(scene, name)) for scene in (one, other))
        assert (a.shape, a.tobytes()) == (b.shape, b.tobytes()), name
    assert (one.antialiased, one.low_pass) == (other.antialiased, other.low_pass)


def decoded(file: PotrFile, rows: np.ndarray) -> tuple[Scene, Scene]:
    whole = SceneArrays(file.header, file.rules, file.sh_count())
    some = Sampled(file.header, file.rules, file.sh_count(), rows)
    file.decode_into(Both(whole, some))
    return whole.scene, some.scene


@pytest.mark.parametrize("native", ["0", ""])
@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_every_third_splat(path, native, monkeypatch):
    monkeypatch.setenv("POTR_CL_NATIVE", native)
    file = PotrFile.open(path)
    rows = np.arange(0, file.header.splats, 3)
    whole, some = decoded(file, rows)
    assert_same_bits(whole, file.scene())
    assert_same_bits(some, whole.subset(rows))


@pytest.mark.parametrize("preset", ["best", "paper"])
def test_a_sample_judges_cameras_as_the_scene_does(preset):
    """More splats than are looked at; twice as many levels as a byte has."""
    scene = random_scene(61_000, 0, seed=2)
    pieces = code_scene(scene, HyperParameters.from_quality(0.9, preset), entropy=EntropyCoder("zstd", 1)).pieces
    file = PotrFile.from_bytes(b"".join(pieces))
    rows = looked_at(file.header.splats)
    assert len(rows) == 60_000
    whole, some = decoded(file, rows)
    assert_same_bits(some, whole.subset(rows))
    cameras = [tilted_camera(seed, 64, 64) for seed in range(3)]
    assert judge_cameras(some, cameras).fit == judge_cameras(whole, cameras).fit
