"""The script that measures the re-fit: it runs, and its report says what it measured."""

from __future__ import annotations

import json
import shutil
import sys

import pytest

from tools.bench import refit as bench_refit


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["bench_refit", *map(str, arguments)])
    bench_refit.main()


@pytest.mark.slow
def test_measure_and_report(monkeypatch, tmp_path, data, capsys):
    scene = tmp_path / "excerpt"
    scene.mkdir()
    shutil.copy(data / "plush_excerpt.ply", scene / "point_cloud.ply")
    shutil.copy(data / "plush_excerpt_cameras.json", scene / "cameras.json")
    out = tmp_path / "out.json"
    few = ["--removed", 0.4, 0.6, "--drops", 1e-10, "--iterations", 4, "--every", 2]
    call(monkeypatch, "measure", scene, "--json", out, *few)
    entry = json.loads(out.read_text())["scenes"]["excerpt"]
    assert set(entry["curves"]) == {
        "as they were",
        "splat by splat",
        "joint",
        "splat by splat, then joint",
        "joint, drop 1e-10",
    }
    for name, points in entry["curves"].items():
        assert [p["splats"] for p in points] == [900, 600]
        if "joint" in name:
            assert all(p["errors"][1] < p["errors"][0] for p in points)
    capsys.readouterr()
    call(monkeypatch, "report", out)
    text = capsys.readouterr().out
    assert f"{entry['curves']['joint'][1]['psnr']:.2f} dB" in text
