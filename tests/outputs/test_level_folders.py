"""Levels in folders, streamed SOG and 3D Tiles: their trees, what is in them and read of them, and errors of leaves."""

from __future__ import annotations

import dataclasses
import errno
import gzip
import itertools
import json
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import potr_cl
from potr_cl import DataError, UsageError, cli
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import WriteError
from potr_cl.formats import load_scene
from potr_cl.formats.registry import bytes_of_scene
from potr_cl.levels.errors import MeasuredErrors, SharedOut, errors_a_coverage, measuring_views, seen_coverage
from potr_cl.model.camera import camera_centres, train_views
from potr_cl.model.views_between import views_between
from potr_cl.opencl.device import Device
from potr_cl.outputs.level_folder import archive
from potr_cl.outputs.lod_tree import Limits, extents_of, lod_tree
from potr_cl.outputs.output import Leaves, Output, Request
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.spz import Gltf
from potr_cl.outputs.streamed_sog import StreamedSog
from potr_cl.outputs.tiles import Tiles
from potr_cl.raster.rasterizer import Rasterizer
from tests.cases.gltf import glb
from tests.cases.scenes import rows_of
from tests.reference.raster import rotation_matrices
from tests.reference.scenes import random_scene

COUNTS = (3000, 1500, 400)


class Told:
    """Errors that are told, in place of measured ones."""

    def __init__(self, far: float = np.inf) -> None:
        self._far = far

    def far(self, scene):
        return scene.means[:, 0] > self._far

    def of_level(self, level: int) -> float:
        return 0.0

    def of_leaves(self, scenes, levels, leaves):
        of_splats, boxes = leaves()
        assert len(of_splats) == len(scenes(0))
        return np.arange(len(boxes))[:, None] * np.arange(levels) / 3


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0


def files_of(part: Output) -> list[bytes]:
    """Levels that are the first splats of a scene."""
    request, scene = Request(HyperParameters.from_quality(0.5, "best")), random_scene(COUNTS[0], 1)
    return [b"".join(part.file(scene[:count], None, request).pieces) for count in COUNTS]


def written(output: Any, files: list[bytes], errors: Any, path: Path) -> tuple[Path, dict[str, Any]]:
    """The description of the levels in a folder, as it is and as what it says."""
    with path.open("wb") as file:
        pieces = output.levelled(files, errors, lambda level: output.of_level().read(files[level]))
        output.write(pieces, file, path)
    return path, json.loads(path.read_text())


@pytest.fixture(scope="module")
def views(plush_excerpt_cameras):
    return train_views(plush_excerpt_cameras)


@pytest.fixture(scope="module")
def files():
    return files_of(Sog())


@pytest.fixture(scope="module")
def folder(files, tmp_path_factory):
    path = tmp_path_factory.mktemp("city") / "lod-meta.json"
    return written(StreamedSog(lod_chunk_count=1), files, Told(), path)


def leaves_of(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [leaf for child in node["children"] for leaf in leaves_of(child)] if "children" in node else [node]


def test_every_level_is_read_as_it_was_encoded_and_lies_within_the_bounds(files, folder):
    path, meta = folder

    def check(node):
        for child in node.get("children", []):
            assert all(np.array(child["bound"]["min"]) >= node["bound"]["min"])
            assert all(np.array(child["bound"]["max"]) <= node["bound"]["max"])
            check(child)

    check(meta["tree"])
    levels = [load_scene(f"{path}#{level}") for level in range(3)]
    assert [rows_of(scene) for scene in levels] == [rows_of(Sog().read(data)) for data in files]
    ends = np.concatenate([[scene.means + s * extents_of(scene) for s in (-1, 1)] for scene in levels], axis=1)
    assert np.allclose(ends[0].min(axis=0), meta["tree"]["bound"]["min"], rtol=1e-5)
    assert np.allclose(ends[1].max(axis=0), meta["tree"]["bound"]["max"], rtol=1e-5)


def test_the_description(folder):
    path, meta = folder
    assert (meta["version"], meta["lodLevels"], meta["counts"]) == (1, 3, list(COUNTS))
    assert meta["count"] == sum(COUNTS)
    assert meta["lodErrors"] is True
    assert "environment" not in meta
    leaves = leaves_of(meta["tree"])
    assert len(leaves) > 4
    for number, leaf in enumerate(leaves):
        assert sum(part["count"] for part in leaf["lods"].values()) <= 1024
        assert leaf["errors"] == pytest.approx([0, number / 3, 2 * number / 3])
    # The runs of each file follow one another and cover it, and a file is of one level.
    runs = sorted(
        (part["file"], part["offset"], part["count"], level) for leaf in leaves for level, part in leaf["lods"].items()
    )
    for number, name in enumerate(meta["filenames"]):
        chunk, own = json.loads((path.parent / name).read_text()), [run for run in runs if run[0] == number]
        ends = list(itertools.accumulate(count for _, _, count, _ in own))
        assert [offset for _, offset, _, _ in own] == [0, *ends[:-1]]
        assert chunk["count"] == ends[-1]
        assert {level for *_, level in own} == {name[0]}
        assert chunk["shN"]["count"] <= chunk["count"]


def test_an_ellipsoid_reaches_as_far_as_its_points():
    scene = random_scene(5, 0)
    points = np.random.default_rng(3).normal(size=(200_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    scene.quaternions[:] /= np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
    axes = rotation_matrices(scene.quaternions.astype(np.float64)) * np.exp(scene.log_scales)[:, None]
    assert np.allclose((points @ axes.transpose(0, 2, 1)).max(axis=1), extents_of(scene), rtol=1e-3)


@pytest.mark.parametrize(
    ("limits", "least"), [(Limits(500, 1e9, 500), 10), (Limits(5000, 1e9, 500), 1), (Limits(5000, 0.3, 100), 8)]
)
def test_nodes_are_split_as_the_limits_say(limits, least):
    scenes = [random_scene(n, 0) for n in COUNTS]
    leaves = list(lod_tree(scenes, limits).leaves())
    assert len(leaves) >= least
    for leaf in leaves:
        centres = np.concatenate([scene.means[rows] for scene, rows in zip(scenes, leaf.rows, strict=True)])
        assert len(centres) <= limits.splats
        assert len(centres) <= limits.fewest or np.ptp(centres, axis=0).max() <= limits.extent
    for level, scene in enumerate(scenes):
        rows = np.concatenate([leaf.rows[level] for leaf in leaves])
        assert np.array_equal(np.sort(rows), np.arange(len(scene)))


def mean_squared_errors(device, scene, others, views) -> list[float]:
    with Rasterizer(device, scene) as one:
        pictures = [one.render(view)[0].clip(0, 1) for view in views]
    found = []
    for other in others:
        with Rasterizer(device, other) as another:
            own = [another.render(view)[0].clip(0, 1) for view in views]
        found.append(float(np.mean([np.square(a - b).mean() for a, b in zip(pictures, own, strict=True)])))
    return found


def test_what_is_far_is_the_environment_once(files, tmp_path):
    """Every level is shown with what the finest one has there; the tree has and counts the others."""
    levels = [Sog().read(data) for data in files]
    far = float(np.quantile(levels[0].means[:, 0], 0.95))
    shown = []

    class Errors(Told):
        def of_leaves(self, scenes, levels, leaves):
            of_splats, boxes = leaves()
            assert np.array_equal(of_splats == len(boxes), self.far(scenes(0)))
            shown.extend(scenes(level) for level in range(levels))
            return np.zeros((len(boxes), levels))

    path, meta = written(StreamedSog(lod_chunk_count=1), files, Errors(far), tmp_path / "lod-meta.json")
    assert meta["environment"] == "env/meta.json"
    sky = levels[0].means[levels[0].means[:, 0] > far]
    assert json.loads((tmp_path / "env" / "meta.json").read_text())["count"] == len(sky) > 0
    for level, (scene, own) in enumerate(zip(levels, shown, strict=True)):
        near = scene.means[scene.means[:, 0] <= far]
        assert meta["counts"][level] == len(near)
        for found in (load_scene(f"{path}#{level}"), own):
            assert np.array_equal(np.sort(found.means, axis=0), np.sort(np.concatenate([near, sky]), axis=0))


def test_errors_of_leaves_add_up_and_say_where(plush_excerpt, views, device):
    """Of a scene whose left half has lost its colours: the error is there, and all of it."""
    left = plush_excerpt.means[:, 0] < np.median(plush_excerpt.means[:, 0])
    other = dataclasses.replace(plush_excerpt, sh=plush_excerpt.sh.copy())
    other.sh[left, 0] += 0.3
    halves = Leaves(left.astype(np.int64), np.zeros((2, 6)))
    with SharedOut(device, plush_excerpt, views, lambda: halves) as shared:
        parts = shared.of([other, plush_excerpt])
    assert not parts[:, :, 1].any()
    right_part, left_part = parts[:, :, 0].mean(axis=0)
    (whole,) = mean_squared_errors(device, plush_excerpt, [other], views)
    assert left_part + right_part == pytest.approx(whole, rel=1e-5)
    assert left_part > 4 * right_part


def test_an_error_times_what_the_leaf_covers_is_what_it_adds(plush_excerpt, views, device):
    fewer = plush_excerpt[::2]
    scenes = [plush_excerpt, fewer]
    boxes = np.concatenate([plush_excerpt.means.min(axis=0), plush_excerpt.means.max(axis=0)])[None]
    leaf = Leaves(np.zeros(len(plush_excerpt), np.int64), boxes)
    views = measuring_views(plush_excerpt, views)
    measured = MeasuredErrors(device, views, plush_excerpt, between=views)
    errors = measured.of_leaves(scenes.__getitem__, 2, lambda: leaf)
    assert errors[0, 0] == 0
    covered = np.array([seen_coverage(view, boxes)[0] for view in views])
    each = [mean_squared_errors(device, plush_excerpt, [fewer], [view])[0] for view in views]
    per_coverage = np.array(each) / covered
    per_coverage[per_coverage.argmax()] = np.sort(per_coverage)[-2]
    assert errors[0, 1] == pytest.approx((per_coverage * covered).sum() / covered.sum(), rel=1e-5)


def test_one_view_within_a_leaf_does_not_tell_its_error():
    parts, covered = np.full((9, 2, 1), 1e-4), np.full((9, 2), 0.1)
    parts[3, 1], covered[3, 1] = 0.5, 1
    assert np.allclose(errors_a_coverage(parts, covered), 1e-3)


def test_errors_are_measured_where_no_level_was_made_for(plush_excerpt, views):
    measuring = camera_centres(measuring_views(plush_excerpt, views))
    for made_for in (views, views_between(plush_excerpt, views, 5)):
        assert np.linalg.norm(camera_centres(made_for)[:, None] - measuring, axis=2).min() > 1e-6
    alone = measuring_views(plush_excerpt, views[:1])
    assert [view.name for view in alone] == [views[0].name]


def test_coverage_is_that_of_playcanvas_engine(plush_excerpt_cameras):
    """Of a box around the middle of the picture: its radius over that and the distance, squared; for 45 degrees."""
    focal = 100 / np.tan(np.radians(22.5))
    view = dataclasses.replace(plush_excerpt_cameras[0], width=240, height=200, fx=focal, fy=focal)
    axis = view.rotation[2]
    centre = view.centre + 5 * axis
    box = np.concatenate([centre - 1, centre + 1])
    nearest = np.linalg.norm(np.clip(view.centre, box[:3], box[3:]) - view.centre)
    behind = np.concatenate([view.centre - 5 * axis - 1, view.centre - 5 * axis + 1])
    around = np.concatenate([view.centre - 1, view.centre + 1])
    expected = [3 / (np.sqrt(3) + nearest) ** 2, 0, 1]
    assert np.allclose(seen_coverage(view, np.array([box, behind, around])), expected)
    wide = dataclasses.replace(view, fx=100.0, fy=100.0)
    assert seen_coverage(wide, box[None])[0] < expected[0]
    upright = dataclasses.replace(view, width=200, height=240)  # the narrower side's field counts
    assert np.allclose(seen_coverage(upright, box[None]), expected[0])


def test_an_encode_makes_a_folder(plush_excerpt, plush_excerpt_cameras, tmp_path):
    """Which is not there yet; and from the result another one."""
    path = tmp_path / "city" / "lod-meta.json"
    choices = {"levels": 3, "lod_chunk_count": 1, "iterations": 2, "refit": 1, "fit": 5, "views_between": 0}
    result = potr_cl.encode(plush_excerpt, plush_excerpt_cameras, output=path, **choices)
    meta = json.loads(path.read_text())
    counts = meta["counts"]
    assert counts[1:] == [round(counts[0] / 2), round(counts[0] / 4)]
    assert [len(load_scene(f"{path}#{level}")) for level in range(3)] == [len(result.order), *counts[1:]] == counts
    for leaf in leaves_of(meta["tree"]):
        assert leaf["errors"][0] == 0 < leaf["errors"][1] <= leaf["errors"][2]
    result.save(tmp_path / "again" / "lod-meta.json")
    made, again = (
        {each.relative_to(folder): each.read_bytes() for each in folder.rglob("*") if each.is_file()}
        for folder in (path.parent, tmp_path / "again")
    )
    assert made == again
    assert result.nbytes == sum(map(len, made.values())) == sum(result.report["properties"].values())


@pytest.mark.parametrize("flag", ["--lod-chunk-count", "--lod-chunk-extent"])
def test_options_and_the_place_are_checked_before_the_work(flag, data, tmp_path, capsys):
    for path, words, said in (
        ("lod-meta.json", (flag, "0"), f"{flag} is 0, it must be above 0"),
        ("tileset.json", (flag, "0"), f"{flag} is 0, it must be above 0"),
        ("a.potr", (flag, "2"), "to choose"),
        ("no/city/lod-meta.json", (), "does not exist"),
    ):
        assert cli.main(["encode", f"{data}/plush_excerpt.ply", "-o", str(tmp_path / path), *words]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="cannot make the folder"):
        StreamedSog().place(tmp_path / "no" / "city" / "lod-meta.json")


# 3D Tiles ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[2, 3])
def tiles(request, tmp_path_factory):
    """What the levels are read as, and the folder."""
    output = Tiles(lod_chunk_count=1, version=request.param)
    files, told = files_of(output.of_level()), SimpleNamespace(of_level=lambda level: level / 4)
    path, _ = written(output, files, told, tmp_path_factory.mktemp("city") / "tileset.json")
    return [Gltf().read(data) for data in files], path


def tiles_of(path: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any] | None]]:
    """Each tile, and the one above it."""
    tiles: list[tuple[dict[str, Any], dict[str, Any] | None]] = [(json.loads(path.read_text())["root"], None)]
    while tiles:
        tile, above = tiles.pop()
        yield tile, above
        tiles += [(child, tile) for child in tile.get("children", [])]


def test_tiles_hold_every_level_as_it_was_encoded(tiles):
    levels, path = tiles
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


def test_a_folder_is_replaced_whole_or_not_at_all(tiles, tmp_path, monkeypatch):
    _, path = tiles
    shutil.copytree(path.parent, tmp_path / "city")
    there = {file: file.read_bytes() for file in (tmp_path / "city").rglob("*") if file.is_file()}
    contents = {str(file.relative_to(tmp_path / "city")): b"other" for file in there}
    left, write = [2], Path.write_bytes

    def full(self, data):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with (tmp_path / "new").open("wb") as file, pytest.raises(WriteError, match="No space left"):
        Tiles().write([archive(contents)], file, tmp_path / "city" / "tileset.json")
    assert {file: file.read_bytes() for file in (tmp_path / "city").rglob("*") if file.is_file()} == there


def test_many_tiles_that_claim_much(tmp_path):
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


def test_finer_tiles_replace_coarser_ones_and_boxes_hold_the_ellipsoids(tiles):
    """In tiles z is up where y is in glTF, whose x, y, z are x, -z, y of tiles."""
    _, path = tiles
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
def test_bad_tilesets(change, message, tiles, tmp_path):
    description = json.loads(tiles[1].read_text())
    change(description)
    (tmp_path / "tileset.json").write_text(json.dumps(description))
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


def test_the_command_writes_tiles(data, tmp_path, capsys):
    path, words = tmp_path / "city" / "tileset.json", ["encode", f"{data}/plush_excerpt.ply", "-o"]
    words += [str(path), "--cameras", f"{data}/plush_excerpt_cameras.json", "--no-quality", "--json"]
    choices = "--levels 2 --lod-chunk-count 1 --iterations 2 --refit 2 --fit 5 --views-between 0"
    assert cli.main([*words, *choices.split()]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(load_scene(path)) == report["splats"]
    assert report["bytes"] == bytes_of_scene(path)
    with pytest.raises(UsageError, match="version 2 or 3"):
        Tiles(version=4)
