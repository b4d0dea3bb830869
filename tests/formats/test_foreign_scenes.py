"""Formats of other tools: what they wrote looks as it should, what we write they would read, damage is told."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from potr_cl.errors import PotrError, UsageError
from potr_cl.formats import load_scene, scene_writer
from potr_cl.opencl.device import Device
from tests.cases.judging import psnr

pytest.importorskip("gsply", reason="the extra convert is not installed")


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
    scene_writer(tmp_path / name, version)(plush_excerpt)
    scene = load_scene(tmp_path / name)
    assert len(scene) == len(plush_excerpt)
    assert psnr(device, plush_excerpt, scene, plush_excerpt_cameras) >= WRITTEN[name, version]
    assert [p.name for p in tmp_path.iterdir()] == [name], "something is left behind"


@pytest.mark.parametrize("name", FOREIGN)
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(draw=st.data())
def test_damage_is_an_error_of_ours_or_does_not_matter(tmp_path, data, name, draw):
    content = bytearray((data / "foreign" / name).read_bytes())
    what = draw.draw(st.sampled_from(["truncate", "bytes", "header", "append"]))
    if what == "truncate":
        del content[draw.draw(st.integers(0, len(content) - 1)) :]
    elif what == "append":
        content += draw.draw(st.binary(max_size=100))
    else:
        last = min(len(content), 600 if what == "header" else len(content)) - 1
        for place in draw.draw(st.lists(st.integers(0, last), min_size=1, max_size=8)):
            content[place] = draw.draw(st.integers(0, 255))
    path = tmp_path / f"damaged{''.join(Path(name).suffixes)}"
    path.write_bytes(content)
    message = ""
    try:
        assert 0 < len(load_scene(path)) < 10000
    except PotrError as error:
        message = str(error)
    assert "\n" not in message
    assert not message or str(path) in message


@pytest.mark.parametrize("name", ["a.spz", "a.sog"])
def test_no_file(tmp_path, name):
    with pytest.raises(UsageError, match="cannot open"):
        load_scene(tmp_path / name)
    (tmp_path / name).mkdir()
    with pytest.raises(UsageError, match="not a regular file"):
        load_scene(tmp_path / name)
