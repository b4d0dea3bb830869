"""Streamed SOG: the tree and its leaves, the chunks, what is read of them, and the errors of leaves."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import potr_cl
from potr_cl import UsageError, cli
from potr_cl.codec.quantize import HyperParameters
from potr_cl.formats import load_scene
from potr_cl.levels.errors import MeasuredErrors, SharedOut, errors_a_coverage, measuring_views, seen_coverage
from potr_cl.model.camera import camera_centres, train_views
from potr_cl.model.views_between import views_between
from potr_cl.opencl.device import Device
from potr_cl.outputs.lod_tree import Limits, extents_of, lod_tree
from potr_cl.outputs.output import Request
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.streamed_sog import StreamedSog
from potr_cl.raster.rasterizer import Rasterizer
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

    def of_leaves(self, scenes, levels, leaves, boxes):
        assert len(leaves) == len(scenes(0))
        return np.arange(len(boxes))[:, None] * np.arange(levels) / 3


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0


@pytest.fixture(scope="module")
def files() -> list[bytes]:
    request = Request(HyperParameters.from_quality(0.5, "best"))
    scene = random_scene(COUNTS[0], 1)
    return [b"".join(Sog().file(scene.subset(np.arange(n)), None, request).pieces) for n in COUNTS]


def written(files: list[bytes], errors: Told, path: Path) -> tuple[Path, dict[str, Any]]:
    """The description of the levels in a folder, as it is and as what it says."""
    output = StreamedSog(lod_chunk_count=1)
    with path.open("wb") as file:
        output.write(output.levelled(files, errors), file, path)
    return path, json.loads(path.read_text())


@pytest.fixture(scope="module")
def folder(files, tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    return written(files, Told(), tmp_path_factory.mktemp("city") / "lod-meta.json")


def leaves_of(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [leaf for child in node["children"] for leaf in leaves_of(child)] if "children" in node else [node]


def test_every_level_is_read_as_it_was_encoded_and_lies_within_the_bounds(files, folder):
    path, meta = folder

    def check(node: dict[str, Any]) -> None:
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
        def of_leaves(self, scenes, levels, leaves, boxes):
            assert np.array_equal(leaves == len(boxes), self.far(scenes(0)))
            shown.extend(scenes(level) for level in range(levels))
            return np.zeros((len(boxes), levels))

    path, meta = written(files, Errors(far), tmp_path / "lod-meta.json")
    assert meta["environment"] == "env/meta.json"
    sky = levels[0].means[levels[0].means[:, 0] > far]
    assert json.loads((tmp_path / "env" / "meta.json").read_text())["count"] == len(sky) > 0
    for level, (scene, own) in enumerate(zip(levels, shown, strict=True)):
        near = scene.means[scene.means[:, 0] <= far]
        assert meta["counts"][level] == len(near)
        for found in (load_scene(f"{path}#{level}"), own):
            assert np.array_equal(np.sort(found.means, axis=0), np.sort(np.concatenate([near, sky]), axis=0))


def test_errors_of_leaves_add_up_and_say_where(plush_excerpt, plush_excerpt_cameras, device):
    """Of a scene whose left half has lost its colours: the error is there, and all of it."""
    views = train_views(plush_excerpt_cameras)
    left = plush_excerpt.means[:, 0] < np.median(plush_excerpt.means[:, 0])
    other = dataclasses.replace(plush_excerpt, sh=plush_excerpt.sh.copy())
    other.sh[left, 0] += 0.3
    with SharedOut(device, plush_excerpt, views, left.astype(np.int64), 2) as shared:
        parts = shared.of([other, plush_excerpt])
    assert not parts[:, :, 1].any()
    right_part, left_part = parts[:, :, 0].mean(axis=0)
    (whole,) = mean_squared_errors(device, plush_excerpt, [other], views)
    assert left_part + right_part == pytest.approx(whole, rel=1e-5)
    assert left_part > 4 * right_part


def test_an_error_times_what_the_leaf_covers_is_what_it_adds(plush_excerpt, plush_excerpt_cameras, device):
    fewer = plush_excerpt[::2]
    scenes = [plush_excerpt, fewer]
    boxes = np.concatenate([plush_excerpt.means.min(axis=0), plush_excerpt.means.max(axis=0)])[None]
    leaves = np.zeros(len(plush_excerpt), np.int64)
    views = measuring_views(plush_excerpt, train_views(plush_excerpt_cameras))
    errors = MeasuredErrors(device, views, plush_excerpt, between=views).of_leaves(scenes.__getitem__, 2, leaves, boxes)
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


def test_errors_are_measured_where_no_level_was_made_for(plush_excerpt, plush_excerpt_cameras):
    views = train_views(plush_excerpt_cameras)
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
    result = potr_cl.encode(
        plush_excerpt, plush_excerpt_cameras, levels=3, lod_chunk_count=1, iterations=2, refit=1, views_between=0,
        output=path,
    )  # fmt: skip
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
        ("a.potr", (flag, "2"), "to choose"),
        ("no/city/lod-meta.json", (), "does not exist"),
    ):
        assert cli.main(["encode", f"{data}/plush_excerpt.ply", "-o", str(tmp_path / path), *words]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="cannot make the folder"):
        StreamedSog().place(tmp_path / "no" / "city" / "lod-meta.json")
