"""The .splat and .ksplat formats: what is special to them, and bad files; good ones are among those of other tools."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potr_cl import DataError, PotrError
from potr_cl.formats import load_scene

SECTION = 4096


def changed(source: Path, target: Path, *changes: tuple[int, str, Any]) -> Path:
    """A copy with some fields changed: where, as what, to what."""
    data = bytearray(source.read_bytes())
    for at, kind, value in changes:
        struct.pack_into(f"<{kind}", data, at, value)
    target.write_bytes(data)
    return target


@pytest.fixture(params=[0, 1, 2])
def source(request, data):
    return data / "other_tools" / f"GaussianSplats3D_level_{request.param}.ksplat"


@pytest.mark.parametrize(
    ("at", "kind", "value", "message"),
    [
        (0, "B", 1, "version 1.1"),
        (1, "B", 0, "version 0.0"),
        (20, "H", 3, "compression level 3"),
        (4, "I", 2**32 - 1, "tells of 4294967295 sections"),
        (4, "I", 0, "has no splats"),
        (SECTION, "I", 0, "has no splats"),
        (SECTION, "I", 2**31, "truncated: a section announces"),
        (SECTION + 4, "I", 2**31, "truncated: a section announces 2147483648 splats"),
        (SECTION + 4, "I", 10, "truncated|damaged"),
        (SECTION + 36, "I", 2**32 - 1, "truncated"),
        (SECTION + 40, "H", 4, "SH degree 4"),
        (SECTION + 40, "H", 3, "truncated|damaged|room"),
    ],
)
def test_headers_that_are_refused(source, tmp_path, at, kind, value, message):
    with pytest.raises(DataError, match=message):
        load_scene(changed(source, tmp_path / "a.ksplat", (at, kind, value)))


@pytest.mark.parametrize(
    ("at", "kind", "value"),
    [
        *((at, "I", value) for at in (8, 12, 32, 1024) for value in (0, 2**32 - 1)),
        (16, "f", float("nan")),
        (20, "H", 0),
        (20, "H", 65535),
        (36, "I", 0),
    ],
)
def test_buckets_that_are_refused(data, tmp_path, at, kind, value):
    source = data / "other_tools" / "GaussianSplats3D_level_1.ksplat"
    with pytest.raises(DataError, match=r"buckets|truncated"):
        load_scene(changed(source, tmp_path / "a.ksplat", (SECTION + at, kind, value)))


def test_any_length_is_refused_or_read(source, tmp_path):
    content = source.read_bytes()
    for size in (0, 1, 4095, 4096, 5119, 5120, 5200, len(content) - 1):
        (tmp_path / "a.ksplat").write_bytes(content[:size])
        with pytest.raises(PotrError, match=r"shorter|truncated"):
            load_scene(tmp_path / "a.ksplat")


def test_sections_with_room_for_more(source, tmp_path):
    """Files that are loaded while they grow have fewer splats than room."""
    part = load_scene(changed(source, tmp_path / "a.ksplat", (SECTION, "I", 20), (16, "I", 20)))
    assert part == load_scene(source)[:20]


def test_several_sections(source, tmp_path):
    content = bytearray(source.read_bytes())
    struct.pack_into("<I", content, 4, 3)
    header, body = bytes(content[SECTION : SECTION + 1024]), bytes(content[SECTION + 1024 :])
    empty = bytes(1024)
    (tmp_path / "a.ksplat").write_bytes(bytes(content[:SECTION]) + header + empty + header + body + body)
    whole, twice = load_scene(source), load_scene(tmp_path / "a.ksplat")
    assert twice == whole[[*range(len(whole))] * 2]


ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def rows(count: int) -> np.ndarray:
    made = np.zeros(count, ROW)
    made["scale"], made["colour"], made["rotation"] = 0.5, 128, (255, 128, 128, 128)
    return made


@pytest.mark.parametrize("size", [0, 31, 33])
def test_files_of_splat_that_are_no_whole_number_of_splats(size, tmp_path):
    (tmp_path / "a.splat").write_bytes(bytes(size))
    with pytest.raises(DataError, match=rf"no .splat file, or is truncated: it has {size} bytes"):
        load_scene(tmp_path / "a.splat")


def test_values_of_splat(tmp_path):
    """By the definition of the format, for more splats than are read at a time."""
    made = rows(70_000)
    made["mean"][:, 0] = np.arange(70_000)
    made["colour"][69_999] = (0, 255, 51, 51)
    made["rotation"][69_999] = (0, 255, 255, 0)
    (tmp_path / "a.splat").write_bytes(made.tobytes())
    scene = load_scene(tmp_path / "a.splat")
    assert scene.sh_degree == 0
    np.testing.assert_array_equal(scene.means[:, 0], np.arange(70_000))
    np.testing.assert_allclose(scene.scales, 0.5, rtol=1e-6)
    colours = scene.sh[69_999, 0] * 0.28209479 + 0.5
    np.testing.assert_allclose(colours, [0, 1, 0.2], atol=1e-6)
    assert scene.opacities[69_999] == pytest.approx(0.2)
    np.testing.assert_allclose(scene.quaternions[69_999], [-0.5, 0.5, 0.5, -0.5], atol=1e-6)


def test_scales_of_splat_without_a_logarithm(tmp_path):
    made = rows(4)
    made["scale"][0, 2], made["scale"][1, 0], made["scale"][2, 1] = 0, -1, np.nan
    (tmp_path / "a.splat").write_bytes(made.tobytes())
    scene = load_scene(tmp_path / "a.splat")
    assert len(scene) == 2
    assert scene.scales[0, 2] == pytest.approx(1e-9, rel=1e-5)
