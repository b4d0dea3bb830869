"""What is said of a scene, in every format: counts, bounds, histograms, and each thing that looks wrong."""

from __future__ import annotations

import base64
import dataclasses
import json
import shutil

import numpy as np
import pytest

import potr_cl
from potr_cl import Scene
from potr_cl.formats import registry
from potr_cl.formats.scenes import page, ply
from potr_cl.report.scene import format_scene, scene_report
from tests.reference.scenes import random_scene


@pytest.fixture
def scene(plush_excerpt) -> Scene:
    return plush_excerpt


def found(scene: Scene) -> dict[str, int]:
    return {entry["what"]: entry["splats"] for entry in potr_cl.info(scene)["suspicious"]}


def changed(scene: Scene, **arrays) -> Scene:
    return dataclasses.replace(scene, **{name: np.asarray(array, np.float32) for name, array in arrays.items()})


def test_a_good_scene_is_not_suspicious(scene):
    assert found(scene) == {}


@pytest.mark.slow
def test_nor_are_whole_trained_scenes(lego, plush):
    for folder in (lego, plush):
        assert potr_cl.info(folder / "point_cloud.ply").suspicious == []


def test_facts(scene):
    report = scene_report(scene)
    assert (report["splats"], report["sh_degree"]) == (1500, 3)
    assert np.array_equal(report["bounding_box"], [scene.means.min(axis=0), scene.means.max(axis=0)])
    (low, high), (inner_low, inner_high) = report["bounding_box"], report["robust_bounding_box"]
    assert all(a <= b < c <= d for a, b, c, d in zip(low, inner_low, inner_high, high, strict=True))
    for name, values in (("opacity", scene.opacities), ("scale", scene.scales.max(axis=1))):
        facts = report[name]
        assert sum(facts["counts"]) == 1500
        assert len(facts["edges"]) == len(facts["counts"]) + 1
        assert facts["edges"] == sorted(facts["edges"])
        assert facts["quantiles"]["median"] == pytest.approx(np.median(values), rel=1e-5)
        inner = np.histogram(values, facts["edges"])[0]
        assert np.abs(inner - facts["counts"]).sum() <= 6, "but for what lies beyond the outermost edges"
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_bars_are_as_long_as_what_they_count(scene):
    lines = format_scene(scene_report(scene)).splitlines()
    counts = scene_report(scene)["opacity"]["counts"]
    bars = [line.count("#") for line in lines if line.startswith("  ") and " to " in line][:10]
    assert max(bars) == 40
    assert bars[int(np.argmax(counts))] == 40
    assert all(bar == pytest.approx(40 * n / max(counts), abs=1) for bar, n in zip(bars, counts, strict=True))
    assert lines[-1] == "suspicious      nothing"


def test_outliers_do_not_move_the_robust_bounds(scene):
    report = scene_report(put(scene, "means", slice(5), 1e4))
    assert report["bounding_box"][1] == [1e4] * 3
    assert max(report["robust_bounding_box"][1]) < 5


def put(scene: Scene, name: str, where, value) -> Scene:
    array = getattr(scene, name).copy()
    array[where] = value
    return changed(scene, **{name: array})


#: What is changed, and what is said of it: of how many of the 1500 splats.
WRONG = {
    "non_finite": (lambda s: put(put(s, "sh", (slice(3), 5, 1), np.nan), "means", 3, np.inf), 4),
    "zero_quaternions": (lambda s: put(s, "quaternions", slice(10, 17), 0), 7),
    "infinite_opacities": (lambda s: put(s, "opacity_logits", slice(2), np.inf), 2),
    "all_transparent": (lambda s: changed(s, opacity_logits=np.linspace(-20, -9, 1500)), 1500),
    "mostly_transparent": (
        lambda s: put(s, "opacity_logits", slice(1400), -20),
        lambda s: 1400 + np.count_nonzero(s.opacities[1400:] < 1 / 255),
    ),
    "activated_opacities": (lambda s: changed(s, opacity_logits=s.opacities), 1500),
    "activated_scales": (lambda s: changed(s, log_scales=s.scales), 1500),
    "activated_colours": (lambda s: put(s, "sh", np.s_[:, 0], np.clip(0.5 + 0.28 * s.sh[:, 0], 0, 1)), 1500),
    "unused_sh_degree": (lambda s: put(s, "sh", np.s_[:, 1:], 0), 1500),
    "unused_sh_degree: 3": (lambda s: put(s, "sh", np.s_[:, 9:], 0), 1500),
    "duplicated_positions": (lambda s: put(s, "means", np.s_[700:1000], s.means[:300]), 300),
    "far_outliers": (lambda s: put(s, "means", np.s_[::300], s.means[::300] + 1e5), 5),
    "huge_scales": (lambda s: put(s, "log_scales", slice(6), 3), 6),
    "flat_scales": (lambda s: put(s, "log_scales", np.s_[:, 0], -30), 1500),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_looks_wrong_is_said(scene, what, tmp_path, caplog):
    change, count = WRONG[what]
    bad, count = change(scene), count(scene) if callable(count) else count
    expected = {what.partition(":")[0]: count} | ({"huge_scales": 1500} if what == "activated_scales" else {})
    assert found(bad) == expected
    info = potr_cl.info(bad)
    assert info.suspicious
    assert all(line in str(info) for line in info.suspicious)
    if count < 1500:
        assert f"{count:,} " in info.suspicious[0]
    # From a file, whose reader mends what cannot be kept, the same is said, and once.
    path = tmp_path / "bad.ply"
    ply.save(path, bad)
    assert {entry["what"]: entry["splats"] for entry in potr_cl.info(path)["suspicious"]} == expected
    assert not caplog.records


def test_two_zeros_are_one_place():
    scene = random_scene(100, 0)
    means = scene.means.copy()
    means[:50, 0], means[:50, 1:] = 0.0, 1.0
    means[:25, 0] = -0.0
    assert found(changed(scene, means=means))["duplicated_positions"] == 49


@pytest.mark.parametrize("count", [1, 2, 3])
def test_scenes_of_few_splats(count):
    scene = random_scene(count, 1)
    assert scene_report(scene)["splats"] == count
    assert str(potr_cl.info(scene))


def test_extreme_values_are_told_in_numbers_that_json_knows():
    scene = random_scene(200, 0)
    log_scales = scene.log_scales.copy()
    log_scales[0], log_scales[1] = 3e38, -3e38
    means = scene.means.copy()
    means[2] = 3e38
    report = scene_report(changed(scene, log_scales=log_scales, means=means))
    json.dumps(report, allow_nan=False)
    assert format_scene(report)


def test_every_format_that_is_read_is_told(tmp_path, data, scene):
    files = [path for path in (data / "foreign").iterdir() if path.is_file()]
    for entry in registry.SCENE_FORMATS:
        if entry.save is not None and (entry is not page.FORMAT or page.TEMPLATE.exists()):
            path = tmp_path / f"scene{entry.suffixes[0]}"
            potr_cl.save(scene, path)
            files.append(path)
    # Opacities in steps that are fine enough for the comparison below.
    potr_cl.encode(scene, prune=False, refit=False, compact=False, sf_opacity=30, output=tmp_path / "scene.potr")
    files.append(tmp_path / "scene.potr")
    coded = base64.b64encode((tmp_path / "scene.potr").read_bytes())
    (tmp_path / "scene.html").write_bytes(page.BEGIN + coded + page.END)
    files.append(tmp_path / "scene.html")
    told = set()
    opacities, scales = scene.opacities, np.exp(scene.log_scales.max(axis=1))
    for path in files:
        info = potr_cl.info(path)
        assert info["splats"] == len(scene)
        assert info["bytes"] == path.stat().st_size
        assert info["opacity"]["quantiles"]["median"] == pytest.approx(np.median(opacities), abs=0.02), path
        assert info["scale"]["quantiles"]["median"] == pytest.approx(np.median(scales), rel=0.1), path
        assert np.allclose(info["robust_bounding_box"], scene_report(scene)["robust_bounding_box"], atol=5e-3), path
        told.add(info["format"])
    for path in (data / "other_tools").rglob("*"):  # of another scene
        kinds = [entry for entry in registry.SCENE_FORMATS if path.name.lower().endswith(entry.suffixes)]
        if (path.is_file() and kinds) or path.name in ("splat-transform_lod", "splat-transform_sog"):
            info = potr_cl.info(path)
            assert info["splats"] == len(potr_cl.read_scene(path)), path
            assert sum(info["opacity"]["counts"]) == info["splats"]
            told.add(info["format"])
    tile = {"boundingVolume": {"sphere": [0, 0, 0, 9]}, "geometricError": 0, "content": {"uri": "tile.glb"}}
    tileset = {"asset": {"version": "1.1"}, "geometricError": 1, "root": tile}
    (tmp_path / "tileset.json").write_text(json.dumps(tileset))
    shutil.copy(data / "other_tools" / "splat-transform.glb", tmp_path / "tile.glb")
    info = potr_cl.info(tmp_path / "tileset.json")
    assert info["splats"] == len(potr_cl.read_scene(tmp_path / "tile.glb"))
    told.add(info["format"])
    assert told == {entry.name for entry in registry.SCENE_FORMATS}
