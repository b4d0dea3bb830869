"""Every benchmark on an excerpt: it runs, and keeps what it prints; and what they compute of their own."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import json
import sys

import numpy as np
import pytest

from potr_cl.model.camera import camera_centres
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor
from tests.cases.ridges import channels, dense_weights, on_a_sphere, sparse_weights
from tools.bench import encode, scaling
from tools.bench.codec import CODERS
from tools.bench.encode import STAGES, Row, on_front
from tools.bench.scaling import exponents, foretold
from tools.stress.solvers import ridge_errors
from tools.workloads import excerpt


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return excerpt(tmp_path_factory.mktemp("scene") / "excerpt")


@pytest.fixture
def tables(tmp_path, monkeypatch):
    """Runs a benchmark and gives the rows that it keeps, by table."""

    def run(name, *words):
        path = tmp_path / "kept.json"
        monkeypatch.setattr(sys, "argv", [name, *map(str, words), "--json", str(path)])
        importlib.import_module(f"tools.bench.{name}").main()
        return {key: table["rows"] for key, table in json.loads(path.read_text()).items()}

    return run


def test_the_front():
    rows = [Row("s", "a", 1, 1), Row("s", "b", 2, 0.5), Row("s", "c", 2, 1), Row("s", "d", 1.01, 1)]
    assert [on_front(row, rows) for row in rows] == [True, True, False, True]


def test_ridge_errors_are_those_of_the_solution(plush_excerpt):
    scene = plush_excerpt.subset(np.arange(50))
    centres, weights = on_a_sphere(30), dense_weights(sparse_weights(50, 30))
    options = CompactionOptions(lam=0.1, alpha=1)
    compacted = Compactor(Device()).compact(scene, centres, weights, options)
    seen = np.diff(weights.offsets) > 0
    assert ridge_errors(scene, compacted, centres, weights, options).max() < 2e-6
    off = compacted.sh.copy()
    off[:, 0] += 0.01
    errors = ridge_errors(scene, dataclasses.replace(compacted, sh=off), centres, weights, options)
    assert len(errors) == seen.sum()
    # DC's basis value times the change of Y.
    scale = np.maximum(np.abs(channels(scene.sh)[seen]).max(axis=(1, 2)), 1)
    assert np.median(errors[:, 0]) == pytest.approx(0.0028 / np.median(scale), rel=0.3)


def test_the_views_of_a_workload(folder):
    load = encode.Workload.of(choose_device(), folder, quick=True)
    assert camera_centres(load.some).shape == (2, 3)
    assert {c.split for c in load.train} == {"train"}


@pytest.mark.slow
def test_every_stage(folder, capsys):
    rows = encode.run(choose_device().index, folder, True, list(STAGES))
    for stage in STAGES:
        own = [row for row in rows if row.stage == stage]
        assert len(own) > 3
        assert all(np.isfinite([row.seconds, row.error]).all() and row.seconds > 0 for row in own)
        assert [row.default for row in own].count(True) == 1, stage
    default = {row.stage: row.error for row in rows if row.default}
    assert default["tile lists"] == default["sort"] == 0
    assert 0 < default["composite"] < 1e-4
    assert 0 < default["project"] < 1e-3
    encode.report(encode.Results(None), "excerpt", rows)
    assert all(f"excerpt: {stage}:" in capsys.readouterr().out for stage in ["project"])


@pytest.mark.slow
def test_steps_of_the_fit(tables, folder):
    (steps,) = tables("fit", folder, "--every", 4, "--steps", 4, "--batches", 2)["steps"]
    assert steps[1] == 375
    assert min(steps[4:]) > 0


@pytest.mark.slow
def test_orders_of_pruning(tables, folder):
    found = tables("pruning", folder, "--every", 2, "--iterations", 2, "--removed", 20, 50)
    curves = {row[0]: row[1:] for row in found["curves_excerpt"]}
    assert all(few > many for few, many in curves.values())
    assert curves["ours, 2 iterations"][1] > max(curves[name][1] for name in ("importance", "opacity", "random"))


@pytest.mark.slow
def test_frames_and_decodes(tables, folder, monkeypatch):
    found = tables("rasterizer", folder, "--views", 2, "--passes", 1)
    assert found["frames"][0][:3] == ["excerpt", 1500, "240 x 180"]
    assert {"project", "composite"} <= {row[0] for row in found["kernels_excerpt"]}
    if sys.platform == "linux":
        monkeypatch.setattr("tools.bench.codec.CODERS", CODERS[-1:])
        monkeypatch.setattr("tools.bench.codec._MADE", ("best",))
        monkeypatch.setattr("tools.bench.codec.processors", lambda: 1)
        found = tables("codec", "--splats", 2000, "--runs", 1)
        assert [row[:2] for row in found["encode"]] == [["bundles", "yes"]]
        assert {row[0] for row in found["speed"]} == {"2000-best"}
        assert all(value > 0 for row in found["speed"] for value in row[3:])
        assert all(row[3] > 0.5 for row in found["memory"])


def test_the_exponents():
    measured = [
        {"splats": n, "views": v, "devices": w, "time": 3e-6 * n**1.2 * v**0.5 / w}
        for n, v, w in itertools.product((100, 400), (5, 20), (1, 4))
    ]
    found, deviation = exponents(measured, "time")
    assert found == pytest.approx({"splats": 1.2, "views": 0.5, "devices": -1})
    assert deviation < 1e-9
    alone, _ = exponents([row for row in measured if row["devices"] == 1], "time")
    assert list(alone) == ["splats", "views"]


def test_what_more_devices_will_take():
    """Of what the model says: 5 s by one, 12 s shared out, and 2 s for what each further device sends."""
    measured = {n: (5 + 12 / n + 2 * (n - 1), 80e9 * (n - 1)) for n in (1, 2)}
    assert foretold(measured, 4) == pytest.approx(5 + 3 + 6)
    assert foretold({1: (9.0, 0.0), 2: (11.0, 0.0)}, 8) == 9.0  # what two take longer is no less for eight


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not say what memory a child has taken")
def test_encodes_of_cities(tables, folder):
    options = "--encode=--iterations 2 --preset fast"
    found = tables("scaling", folder, "--cities", "2000x4", "4000x4", "3000x5", "3000x4", "--size", "64x48", options)
    assert [row[:3] for row in found["points"]] == [[2000, 4, 1], [4000, 4, 1], [3000, 5, 1], [3000, 4, 1]]
    names = [column.split("|")[0] for column in scaling._COLUMNS.split("; ")]
    for row in found["points"]:
        figures = dict(zip(names, row, strict=True))
        assert sum(figures[part] for part in scaling.PARTS) == pytest.approx(figures["all"])
        assert all(figures[name] > 0 for name in ("pruning", "re-fit", "judging", "host peak", "PSNR"))
        assert figures["splats left"] < figures["splats"]
    assert {row[0] for row in found["exponents"]} == set(scaling.FIGURES)
