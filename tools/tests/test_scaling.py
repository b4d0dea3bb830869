"""Time and memory against splats, views and workers: what is measured, and the exponents through it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tools.bench import scaling
from tools.bench.scaling import Point, exponents, measured_in_turn, points


def test_one_number_at_a_time():
    found = [(p.splats, p.views, p.workers) for p in points([10, 20, 40], [3, 5], [1, 2])]
    assert found == [(10, 3, 1), (20, 3, 1), (20, 5, 1), (20, 3, 2), (40, 3, 1)]


def test_the_exponents():
    measured = [Point(n, v, w, seconds=3e-6 * n**1.2 * v**0.5 / w) for n in (100, 400) for v in (5, 20) for w in (1, 4)]
    found, deviation = exponents(measured, "seconds")
    assert found == pytest.approx({"splats": 1.2, "views": 0.5, "workers": -1})
    assert deviation < 1e-9
    alone, _ = exponents([point for point in measured if point.workers == 1], "seconds")
    assert list(alone) == ["splats", "views"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the host's peak is Linux's figure")
def test_encodes_are_measured(data, tmp_path, monkeypatch, capsys):
    source = f"{data / 'plush_excerpt.ply'},{data / 'plush_excerpt_cameras.json'}"
    words = [source, "--splats", "2000", "4000", "--views", "4", "--workers", "1", "2", "--size", "64x48"]
    monkeypatch.setattr(sys, "argv", ["scaling", *words, "--iterations", "2", "--json", str(tmp_path / "a.json")])
    monkeypatch.chdir(Path(scaling.__file__).parents[2])
    scaling.main()
    results = json.loads((tmp_path / "a.json").read_text())
    assert [row[0] for row in results["points"]["rows"]] == [2000, 2000, 4000]
    assert all(row[3] > 0 and row[7] > 0 and row[8] > 0 for row in results["points"]["rows"])
    assert {row[0] for row in results["exponents"]["rows"]} == set(scaling.FIGURES.values())


def test_no_encode_begins_after_the_limit(data, monkeypatch):
    source = f"{data / 'plush_excerpt.ply'},{data / 'plush_excerpt_cameras.json'}"
    begun = []
    monkeypatch.setattr(scaling, "in_process", lambda point, folder, passed: begun.append(point) or point)
    wanted = points([2000, 4000], [4, 8], [1])
    assert list(measured_in_turn(wanted, [source], "64x48", (), None)) == wanted == begun
    assert not list(measured_in_turn(wanted, [source], "64x48", (), -1.0))
