"""The scripts that measure size against quality: what they compute of their own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.model.camera import test_views as judging_views
from potr_cl.pipeline.options import EncodeOptions
from tests.devices import shared_device
from tests.reference.scenes import random_scene
from tools.study import ablation, formats, placed_views, rate_distortion
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import merged
from tools.workloads import excerpt


@pytest.fixture
def folder(tmp_path):
    """The excerpt as a scene's folder."""
    return excerpt(tmp_path / "excerpt")


def call(monkeypatch, tool, *arguments):
    monkeypatch.setattr(sys, "argv", ["tool", *map(str, arguments)])
    tool.main()


def test_series():
    name, options = rate_distortion.parse_series("no colours:refit=False,prune.iterations=8,compact.colour_model=rgb")
    assert (name, options) == ("no colours", {"refit": False, "prune.iterations": 8, "compact.colour_model": "rgb"})
    chosen = rate_distortion.encode_options({**options, "preset": "fast", "q": 0.4})
    assert (chosen.refit.on, chosen.prune.iterations, chosen.compact.colour_model) == (False, 8, "rgb")
    assert (chosen.preset, chosen.q) == ("fast", 0.4)
    assert rate_distortion.encode_options({}) == EncodeOptions()
    _, options = rate_distortion.parse_series("near:preset=smallest,photos=True")
    for images in (Path("a"), Path("b")):
        assert rate_distortion.encode_options(options, images).refit.ground_truth == images
    with pytest.raises(UsageError, match="'speed' is no option"):
        rate_distortion.parse_series("a:speed=1")


def test_a_curve_is_measured_written_and_continued(monkeypatch, folder, tmp_path, capsys):
    out = tmp_path / "out.json"
    call(monkeypatch, rate_distortion, "measure", folder, "--json", out, "--qualities", 0.3)
    first = json.loads(out.read_text())["scenes"]["excerpt"]["series"]["default"]["encodes"]
    call(monkeypatch, rate_distortion, "measure", folder, "--json", out, "--qualities", 0.1, 0.3)
    points = json.loads(out.read_text())["scenes"]["excerpt"]["series"]["default"]["encodes"]
    assert [p["q"] for p in points] == [0.1, 0.3]
    assert points[1] == first[0], "measured again"
    assert points[0]["bytes"] < points[1]["bytes"]
    assert sum(points[0]["sections"].values()) == points[0]["bytes"]
    capsys.readouterr()
    call(monkeypatch, rate_distortion, "report", out)
    assert f"| {points[0]['psnr']:.2f} |" in capsys.readouterr().out


@pytest.mark.slow
def test_series_of_the_sweeps_options_and_their_gaps(monkeypatch, folder, tmp_path, capsys):
    out = tmp_path / "out.json"
    series = tuple(f"{name}:preset=paper,prune.iterations=4" for name in ("plain", "same"))
    series += ("lazy:preset=paper,prune.iterations=2",)
    call(monkeypatch, rate_distortion, "measure", folder, "--json", out, "--qualities", 0.4, 0.6, "--series", *series)
    capsys.readouterr()
    call(monkeypatch, rate_distortion, "report", out, "--against", "plain", "--at", 0.4)
    said = capsys.readouterr().out
    rows = {line.split(" | ")[0].strip("| "): line for line in said.splitlines()}
    assert "+0.0 |" in rows["plain"]
    assert "+0.0 |" in rows["same"]
    assert "+0.0 |" not in rows["lazy"]
    for name, quality in (("plane", 0.4), ("plain", 0.5)):
        with pytest.raises(UsageError, match=f"no encode of '{name}' at quality {quality}"):
            call(monkeypatch, rate_distortion, "report", out, "--against", name, "--at", quality)


def run_of(path, commit, scenes, machine="a", **points):
    """A file of measure: for each scene the same series, of each quality so many bytes."""
    series = {
        name: {"options": {}, "encodes": [{"q": q, "bytes": size} for q, size in of_it.items()]}
        for name, of_it in points.items()
    }
    about = {"commit": commit, "machine": machine, "date": "2026-01-01", "command": [f"python {commit}"]}
    entries = {scene: {"scene": scene, "source_bytes": 9, "series": series} for scene in scenes}
    path.write_text(json.dumps({**about, "scenes": entries}))
    return path


def test_later_files_replace_points_and_add_others(tmp_path):
    """A run that goes on where a file of another commit stops leaves points of both."""
    a = run_of(tmp_path / "a", "aaaaaaa", ["s", "t"], best={0.5: 5, 0.1: 1}, fast={0.5: 6})
    b = run_of(tmp_path / "b", "bbbbbbb", ["s"], machine="b", best={0.3: 3, 0.5: 4})
    content = json.loads(b.read_text())
    content["scenes"]["s"]["series"]["best"]["encodes"][0]["commit"] = "ccccccc"
    b.write_text(json.dumps(content))
    both = merged([a, b])
    points = both["scenes"]["s"]["series"]["best"]["encodes"]
    found = [(p["q"], p["bytes"], p["commit"]) for p in points]
    assert found == [(0.1, 1, "aaaaaaa"), (0.3, 3, "ccccccc"), (0.5, 4, "bbbbbbb")]
    assert [p["bytes"] for p in both["scenes"]["t"]["series"]["best"]["encodes"]] == [1, 5]
    assert both["commit"] == "aaaaaaa; ccccccc; bbbbbbb"
    assert (both["machine"], both["date"]) == ("a; b", "2026-01-01")
    assert both["command"] == ["python aaaaaaa", "python bbbbbbb"]


def test_series_in_the_order_asked_for(tmp_path):
    a = run_of(tmp_path / "a", "aaaaaaa", ["s"], best={0.5: 5}, fast={0.5: 6}, paper={0.5: 7})
    b = run_of(tmp_path / "b", "aaaaaaa", ["t"], best={0.5: 5})
    both = merged([a, b], ["paper", "best"])
    assert [list(entry["series"]) for entry in both["scenes"].values()] == [["paper", "best"], ["best"]]
    assert both["commit"] == "aaaaaaa"
    c = run_of(tmp_path / "c", "ccccccc", ["s"], machine="c", other={0.5: 5})
    assert merged([a, b, c], ["paper", "best"])["machine"] == "a", "a file of which nothing is taken is named"
    with pytest.raises(UsageError, match="there is no series 'slow'"):
        merged([a, b], ["slow"])


def test_interpolation_along_a_curve():
    points = [{"bytes": b, "psnr": p} for b, p in ((4000, 40.0), (1000, 30.0), (16000, 45.0))]
    assert rate_distortion.size_at(points, "psnr", 35.0) == pytest.approx(2000)
    assert rate_distortion.size_at(points, "psnr", 45.1) is None


@pytest.mark.slow
def test_tables_of_curves_and_formats(monkeypatch, folder, tmp_path, capsys):
    """What docs/benchmarks shows of a measurement, and of formats that were measured before it."""
    out, kept = tmp_path / "out.json", tmp_path / "kept.json"
    series = ("--series", "best:preset=best", "fast:preset=fast")
    call(monkeypatch, rate_distortion, "measure", folder, "--json", out, "--qualities", 0.3, 0.5, *series)
    call(monkeypatch, rate_distortion, "measure", folder, "--json", out, "--qualities", 0.9, "--seconds", 0, *series)
    measured = json.loads(out.read_text())
    points = measured["scenes"]["excerpt"]["series"]["best"]["encodes"]
    assert [p["q"] for p in points] == [0.3, 0.5], "an encode began after the time was over"
    call(monkeypatch, rate_distortion, "report", out, "--json", kept)
    tables = json.loads(kept.read_text())
    assert [row[:3] for row in tables["excerpt"]["rows"][:2]] == [["best", p["q"], p["splats"]] for p in points]
    assert [row[:2] for row in tables["stages"]["rows"]] == [["excerpt", "best"], ["excerpt", "fast"]]
    seconds = tables["stages"]["rows"][0][-6:]
    assert sum(seconds[:-1]) == pytest.approx(seconds[-1], rel=0.01)

    sizes = {
        "columns": [{"name": n} for n in ("format", "excerpt: size", "excerpt: PSNR", "excerpt: lost")],
        "rows": [["PLY", 9.0, None, None], ["`.spz` (version 4)", 0.05, points[0]["psnr"], 0.1], ["Other", 1, 1, 1]],
    }
    (tmp_path / "known.json").write_text(json.dumps({"sizes": sizes}))
    monkeypatch.setattr(formats, "KNOWN", tmp_path / "known.json")
    for point in (point for series in measured["scenes"]["excerpt"]["series"].values() for point in series["encodes"]):
        point["psnr_loss"] = 50 - point["psnr"]
    out.write_text(json.dumps(measured))
    words = (folder, "--formats", ".spz:2", "--transform", "/nowhere", "--json", kept, "--curves", out)
    call(monkeypatch, formats, *words, "--q", 0.3, 0.5)
    tables = json.loads(kept.read_text())
    assert [row[:3] for row in tables["outputs_excerpt"]["rows"]] == [
        ["encode", ".spz:2", 0.3],
        ["encode", ".spz:2", 0.5],
        ["convert", ".spz", 1.0],
    ]
    assert [row[0] for row in tables[".spz:2_excerpt"]["rows"]] == [".spz"]
    spz, other = tables["excerpt"]["rows"]
    assert spz[3:5] == pytest.approx([points[0]["bytes"] / 1e6, 5e4 / points[0]["bytes"]])
    assert other[0] == "Other"
    assert other[3].startswith("below")
    call(monkeypatch, formats, *words, "--q", 0.3, "--series", "fast")
    heads = [column["name"] for column in json.loads(kept.read_text())["excerpt"]["columns"]]
    assert "fast at that PSNR" in heads
    with pytest.raises(UsageError, match="there is no series 'smallest'"):
        call(monkeypatch, formats, *words, "--series", "smallest")


def test_rgb_streams_keep_r_g_and_b():
    scene = random_scene(50, 2)
    steps = ablation.as_channels(scene)
    y, co, cg = ablation.quantize.to_ycocg(steps.sh.reshape(-1, 3).astype(np.float64))
    assert np.allclose(np.stack([y, co, cg], -1).reshape(scene.sh.shape), scene.sh, atol=1e-5)
    assert np.allclose(ablation.from_channels(steps).sh, scene.sh, atol=1e-5)
    assert ablation.from_channels(steps).sh.dtype == np.float32


@pytest.mark.slow
def test_ablation(monkeypatch, folder, tmp_path):
    out = tmp_path / "out.json"
    call(monkeypatch, ablation, folder, "--json", out)
    tables = {name: table["rows"] for name, table in json.loads(out.read_text()).items()}
    (_, *steps), (ply, *parts) = tables["excerpt"], tables["bytes_excerpt"]
    sizes = [size for _, _, size, *_ in steps]
    assert len(steps) == len(parts) == 7
    assert sizes[:6] == sorted(sizes[:6], reverse=True), "a part of the codec adds bytes"
    assert steps[0][3] == steps[1][3]
    assert ply[:2] == ["as PLY", 12.0]
    for (_, splats, size, *_), (*_, a_splat) in list(zip(steps, parts, strict=True))[1:]:
        assert 0 < 1e6 * size - a_splat * splats < 3000, "more than the header is missing"


def test_a_part_of_the_views_in_smaller_pictures(folder):
    device = shared_device("cpu")
    with EvaluatedScene(folder, device) as whole, EvaluatedScene(folder, device, few=3, scale=0.5) as part:
        assert len(part.views) == -(-len(whole.views) // 3)
        assert judging_views(part.cameras) == part.views
        assert {camera.width for camera in part.cameras} == {camera.width // 2 for camera in whole.cameras}
        mean, worst = part.mean_and_worst(random_scene(5))
        assert worst <= mean < 60
    for few, scale in ((0, 1.0), (-2, 1.0), (1, 0.0), (1, 2.0), (1, np.nan)):
        with pytest.raises(UsageError, match="give at least 1"):
            EvaluatedScene(folder, device, few=few, scale=scale)


def test_placed_views_against_true_ones(monkeypatch, folder, tmp_path, capsys):
    kept = tmp_path / "placed.json"
    call(monkeypatch, placed_views, folder, "--views", "6x48", "--true", "0.3", "0.5", "--json", kept)
    (table,) = json.loads(kept.read_text()).values()
    (row,) = table["rows"]
    assert row[1] == "6 of 48"
    assert isinstance(row[-1], float)
    with pytest.raises(SystemExit):
        call(monkeypatch, placed_views, folder, "--views", "many")
    assert "invalid" in capsys.readouterr().err
