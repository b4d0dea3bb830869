"""Formats of other tools: what they wrote looks as it should, what we write they would read, damage is told."""

from __future__ import annotations

import dataclasses
import math

import pytest

from potr_cl.formats import load_scene, scene_writer
from potr_cl.opencl.device import Device
from tests.cases.judging import psnr

#: What splat-transform made of the excerpt, and the PSNR in dB that its renders reach: less is a misread convention.
FOREIGN = {
    "version_3.spz": 48,
    "version_4.spz": 48,
    "degree_1.spz": 58,
    "degree_0.sog": 62,
    "degree_3.sog": 52,
    "degree_3.compressed.ply": 59,
    "degree_0.compressed.ply": 72,
}
#: By name and version. SPZ of version 2, the usual one, has coarser rotations than its later versions.
WRITTEN = {
    ("scene.spz", None): 61,
    ("scene.spz", 3): 62,
    ("scene.spz", 4): 62,
    ("scene.compressed.ply", None): 59,
    ("scene.ply", None): math.inf,
}


@pytest.fixture(scope="module")
def device():
    return Device()


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_another_tool_look_as_the_scene_does(device, data, plush_excerpt, plush_excerpt_cameras, name):
    scene = load_scene(data / "foreign" / name)
    plain = dataclasses.replace(plush_excerpt, sh=plush_excerpt.sh[:, : scene.sh.shape[1]])
    assert psnr(device, plain, scene, plush_excerpt_cameras) >= FOREIGN[name]


@pytest.mark.parametrize(("name", "version"), WRITTEN)
def test_what_is_written_looks_as_the_scene_does(device, tmp_path, plush_excerpt, plush_excerpt_cameras, name, version):
    scene_writer(tmp_path / name, version=version)(plush_excerpt)
    scene = load_scene(tmp_path / name)
    assert len(scene) == len(plush_excerpt)
    assert psnr(device, plush_excerpt, scene, plush_excerpt_cameras) >= WRITTEN[name, version]
    assert [p.name for p in tmp_path.iterdir()] == [name], "something is left behind"
