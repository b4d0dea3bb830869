"""How large scenes on disk are that consist of several files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from potr_cl.formats import load_scene
from potr_cl.formats.registry import bytes_of_scene
from tests.cases.gltf import attributes, described, glb, gltf
from tests.reference.scenes import random_scene


def test_a_buffer_beside_a_gltf_file_counts_once(tmp_path: Path) -> None:
    description, content = described(attributes(random_scene(20, 1)))
    (tmp_path / "a.glb").write_bytes(glb(description, content))
    (tmp_path / "a.gltf").write_bytes(gltf(description, content, "a%20b.bin"))
    (tmp_path / "a b.bin").write_bytes(content)
    (tmp_path / "other.bin").write_bytes(content)
    assert bytes_of_scene(tmp_path / "a.gltf") == (tmp_path / "a.gltf").stat().st_size + len(content)
    assert bytes_of_scene(tmp_path / "a.glb") == (tmp_path / "a.glb").stat().st_size


@pytest.fixture
def levels(tmp_path: Path, data: Path) -> Path:
    shutil.copytree(data / "other_tools" / "splat-transform_lod", tmp_path / "lod")
    return tmp_path / "lod"


def test_only_what_is_there_and_belongs_to_it_counts(levels: Path, tmp_path: Path) -> None:
    whole = sum(file.stat().st_size for file in levels.rglob("*") if file.is_file())
    (levels / "notes.json").write_text("{}")
    (levels / "picture.webp").write_bytes(bytes(1000))
    for given in (levels, f"{levels}#1", levels / "lod-meta.json", f"{levels}/lod-meta.json#0"):
        assert bytes_of_scene(given) == whole
    names = json.loads((levels / "lod-meta.json").read_text())["filenames"]
    folder = (levels / names[0]).parent
    gone = sum(file.stat().st_size for file in folder.iterdir())
    shutil.rmtree(folder)
    assert len(load_scene(f"{levels}#1")) > 0
    assert bytes_of_scene(f"{levels}#1") == whole - gone
    for nothing in (tmp_path, tmp_path / "gone.ply", tmp_path / "gone" / "meta.json", "a\0b.ply"):
        assert bytes_of_scene(nothing) is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{",
        b"[" * 100_000,
        b'{"tree": {}, "lodLevels": 1, "filenames": ["../../meta.json"]}',
        b'{"buffers": 1}',
        b'{"asset": {"version": "2.0"}, "buffers": [1, {"uri": "../x"}]}',
        b'{"a": {"files": [1, {}, "/etc/passwd"]}}',
    ],
)
@pytest.mark.parametrize("name", ["lod-meta.json", "meta.json", "a.gltf"])
def test_nothing_is_said_of_damaged_descriptions(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    size = bytes_of_scene(tmp_path / name)
    assert size is None or size == len(content)
