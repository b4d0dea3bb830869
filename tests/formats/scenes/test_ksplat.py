"""The .ksplat format: sections with room for more, and bad files. All formats' tests have good ones of other tools."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

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
def source(request: pytest.FixtureRequest, data: Path) -> Path:
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
def test_headers_that_are_refused(source: Path, tmp_path: Path, at: int, kind: str, value: int, message: str) -> None:
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
def test_buckets_that_are_refused(data: Path, tmp_path: Path, at: int, kind: str, value: float) -> None:
    source = data / "other_tools" / "GaussianSplats3D_level_1.ksplat"
    with pytest.raises(DataError, match=r"buckets|truncated"):
        load_scene(changed(source, tmp_path / "a.ksplat", (SECTION + at, kind, value)))


def test_any_length_is_refused_or_read(source: Path, tmp_path: Path) -> None:
    content = source.read_bytes()
    for size in (0, 1, 4095, 4096, 5119, 5120, 5200, len(content) - 1):
        (tmp_path / "a.ksplat").write_bytes(content[:size])
        with pytest.raises(PotrError, match=r"shorter|truncated"):
            load_scene(tmp_path / "a.ksplat")


def test_sections_with_room_for_more(source: Path, tmp_path: Path) -> None:
    """Files that are loaded while they grow have fewer splats than room."""
    part = load_scene(changed(source, tmp_path / "a.ksplat", (SECTION, "I", 20), (16, "I", 20)))
    assert part == load_scene(source)[:20]


def test_several_sections(source: Path, tmp_path: Path) -> None:
    content = bytearray(source.read_bytes())
    struct.pack_into("<I", content, 4, 3)
    header, body = bytes(content[SECTION : SECTION + 1024]), bytes(content[SECTION + 1024 :])
    empty = bytes(1024)
    (tmp_path / "a.ksplat").write_bytes(bytes(content[:SECTION]) + header + empty + header + body + body)
    whole, twice = load_scene(source), load_scene(tmp_path / "a.ksplat")
    assert twice == whole[[*range(len(whole))] * 2]
