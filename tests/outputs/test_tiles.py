"""3D Tiles: the tree of tiles, what is in them, and what is read of them."""

from __future__ import annotations

import errno
import gzip
import json
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from potr_cl import DataError, Scene, UsageError, cli
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import WriteError
from potr_cl.formats import load_scene
from potr_cl.formats.registry import bytes_of_scene
from potr_cl.outputs.level_folder import archive
from potr_cl.outputs.lod_tree import extents_of
from potr_cl.outputs.output import Request
from potr_cl.outputs.spz import Gltf
from potr_cl.outputs.tiles import Tiles
from tests.cases.gltf import glb
from tests.cases.scenes import rows_of
from tests.reference.scenes import random_scene

COUNTS = (3000, 1500, 400)


@pytest.fixture(scope="module", params=[2, 3])
def made(request: Any, tmp_path_factory: Any) -> tuple[list[Scene], Path]:
    """What the levels are read as, and the folder."""
    output, asked = Tiles(lod_chunk_count=1, version=request.param), Request(HyperParameters.from_quality(0.5, "best"))
    scene = random_scene(COUNTS[0], 1)
    files = [
        b"".join(output.of_level().file(scene.subset(np.arange(n)), None, asked).pieces)
        for n in COUNTS
    ]  # fmt: skip
    path = tmp_path_factory.mktemp("city") / "tileset.json"
    told = SimpleNamespace(of_level=lambda level: level / 4)  # errors, in place of measured ones
    with path.open("wb") as file:
        output.write(output.levelled(files, told), file, path)  # type: ignore[arg-type]
    return [Gltf().read(data) for data in files], path


def tiles_of(path: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any] | None]]:
    """Each tile, and the one above it."""
    tiles: list[tuple[dict[str, Any], dict[str, Any] | None]] = [(json.loads(path.read_text())["root"], None)]
    while tiles:
        tile, above = tiles.pop()
        yield tile, above
        tiles += [(child, tile) for child in tile.get("children", [])]


def test_tiles_hold_every_level_as_it_was_encoded(made: tuple[list[Scene], Path]) -> None:
    levels, path = made
    found: list[set[bytes]] = [set() for _ in COUNTS]
    counts = [0] * len(COUNTS)
    for tile, _ in tiles_of(path):
        if "content" in tile:
            scene, level = load_scene(path.parent / tile["content"]["uri"]), int(tile["content"]["uri"][0])
            found[level] |= rows_of(scene)
            counts[level] += len(scene)
    assert counts == list(COUNTS)
    assert found == [rows_of(scene) for scene in levels]
    assert rows_of(load_scene(path)) == rows_of(load_scene(path.parent)) == found[0]  # the finest tiles are read
    assert bytes_of_scene(path) == sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())


def test_a_folder_is_replaced_whole_or_not_at_all(
    made: tuple[list[Scene], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, path = made
    shutil.copytree(path.parent, tmp_path / "city")
    there = {file: file.read_bytes() for file in (tmp_path / "city").rglob("*") if file.is_file()}
    contents = {str(file.relative_to(tmp_path / "city")): b"other" for file in there}
    left, write = [2], Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with (tmp_path / "new").open("wb") as file, pytest.raises(WriteError, match="No space left"):
        Tiles().write([archive(contents)], file, tmp_path / "city" / "tileset.json")
    assert {file: file.read_bytes() for file in (tmp_path / "city").rglob("*") if file.is_file()} == there


def test_many_tiles_that_claim_much(tmp_path: Path) -> None:
    """Each might hold so many splats by itself."""
    scene = random_scene(1, 0).subset(np.zeros(40_000, np.int64))
    asked = Request(HyperParameters.from_quality(0.5, "best"))
    tile = b"".join(Gltf(version=3).file(scene, None, asked).pieces)
    end = 20 + int.from_bytes(tile[12:16], "little")
    description = json.loads(tile[20:end])
    splats = struct.pack("<4sIIBBBB", b"NGSP", 3, len(scene), 0, 12, 0, 0) + bytes(20 * len(scene))
    packed = gzip.compress(splats, mtime=0)
    for each in (*description["buffers"], *description["bufferViews"]):
        each["byteLength"] = len(packed)
    tile = glb(description, packed)
    tiles = [{"content": {"uri": f"{name}.glb"}} for name in "ab"]
    for each in tiles:
        (tmp_path / each["content"]["uri"]).write_bytes(tile)
    assert len(load_scene(tmp_path / "a.glb")) == 40_000
    (tmp_path / "tileset.json").write_text(json.dumps({"root": {"refine": "ADD", "children": tiles}}))
    with pytest.raises(DataError, match=r"80000 splats in \d+ bytes .*--trust"):
        load_scene(tmp_path)
    assert len(load_scene(tmp_path, trust=True)) == 80_000


def test_finer_tiles_replace_coarser_ones_and_boxes_hold_the_ellipsoids(made: tuple[list[Scene], Path]) -> None:
    """In tiles z is up where y is in glTF, whose x, y, z are x, -z, y of tiles."""
    _, path = made
    description = json.loads(path.read_text())
    assert description["asset"]["version"] == "1.1"
    assert description["root"]["refine"] == "REPLACE"
    assert description["geometricError"] >= description["root"]["geometricError"]
    contents = 0
    for tile, above in tiles_of(path):
        children, error = tile.get("children", []), tile["geometricError"]
        box = np.array(tile["boundingVolume"]["box"])
        centre, half = box[:3], np.abs(box[3:].reshape(3, 3)).sum(axis=0)
        if above is not None:
            assert above["geometricError"] >= error
            outer = np.array(above["boundingVolume"]["box"])
            assert (np.abs(centre - outer[:3]) + half <= np.abs(outer[3:].reshape(3, 3)).sum(axis=0) + 1e-9).all()
        if "content" not in tile:
            assert len(children) == 2
            continue
        contents += 1
        level = int(tile["content"]["uri"][0])
        assert error == (16 * level / 4 if children else 0)
        assert all(int(child["content"]["uri"][0]) < level for child in children)
        scene = load_scene(path.parent / tile["content"]["uri"])
        places = np.stack([scene.means[:, 0], -scene.means[:, 2], scene.means[:, 1]], axis=1)
        extents = extents_of(scene)[:, [0, 2, 1]]
        assert (np.abs(places - centre) + extents <= half * (1 + 1e-6) + 1e-6).all()
    assert contents > 3 * 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("root"), "it has no root"),
        (lambda m: m["root"].update(children=3), "a tile is invalid"),
        (lambda m: m["root"].update(children=[3]), "a tile is invalid"),
        (lambda m: m["root"].update(children=[]), "no tiles with content"),
        (lambda m: m["root"].update(children=[], content=3), "it names a file None"),
        (lambda m: m["root"].update(children=[], content={"uri": "../a.glb"}), "it names a file"),
        (lambda m: m["root"].update(children=[], content={"uri": "a.b3dm"}), "only those of glTF"),
        (lambda m: m["root"]["children"][0].update(transform=[2] * 16), "a place of their own"),
    ],
)
def test_bad_tilesets(
    change: Callable[[Any], Any], message: str, made: tuple[list[Scene], Path], tmp_path: Path
) -> None:
    description = json.loads(made[1].read_text())
    change(description)
    (tmp_path / "tileset.json").write_text(json.dumps(description))
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


def test_the_command_writes_a_folder(data: Path, tmp_path: Path, capsys: Any) -> None:
    path, words = tmp_path / "city" / "tileset.json", ["encode", f"{data}/plush_excerpt.ply", "-o"]
    choices = f"--cameras {data}/plush_excerpt_cameras.json --levels 2 --lod-chunk-count 1 --iterations 2 --refit 2"
    assert cli.main([*words, str(path), *choices.split(), "--views-between", "0", "--no-quality", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(load_scene(path)) == report["splats"]
    assert report["bytes"] == bytes_of_scene(path)
    assert cli.main([*words, str(tmp_path / "tileset.json"), "--lod-chunk-count", "0"]) == 2
    assert "--lod-chunk-count is 0, it must be above 0" in capsys.readouterr().err
    with pytest.raises(UsageError, match="version 2 or 3"):
        Tiles(version=4)
