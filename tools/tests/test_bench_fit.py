"""The tools about the fit, on an excerpt."""

from __future__ import annotations

import json
import sys

import pytest

from tools.bench import fit as bench


@pytest.fixture
def folder(tmp_path, data):
    (tmp_path / "point_cloud.ply").symlink_to(data / "plush_excerpt.ply")
    (tmp_path / "cameras.json").symlink_to(data / "plush_excerpt_cameras.json")
    return tmp_path


@pytest.mark.slow
def test_the_bench_measures_steps_products_and_errors(folder, monkeypatch):
    path = folder / "fit.json"
    arguments = ["fit", str(folder), "--every", "4", "--steps", "4", "--batches", "2", "--json", str(path)]
    monkeypatch.setattr(sys, "argv", arguments)
    bench.main()
    tables = json.loads(path.read_text())
    assert set(tables) == {"steps", "errors"}
    (steps,) = tables["steps"]["rows"]
    assert steps[1] == 375
    assert min(steps[4:]) > 0
    rows = tables["errors"]["rows"]
    assert all(row[3] < 1e-5 for row in rows if row[1] * row[2] < 1)
    assert all(row[3] > 1e-2 for row in rows if row[1] * row[2] > 20), "what exceeds the fixed point is cut"
