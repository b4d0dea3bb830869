"""The benchmark of all stages, on next to nothing."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from potr_cl.model.camera import camera_centres
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor
from tests.cases.ridges import channels, dense_weights, on_a_sphere, sparse_weights
from tools.bench import encode as benchmark
from tools.bench import stage_variants, tradeoffs
from tools.bench.tradeoffs import Row, on_front
from tools.workloads import excerpt


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return excerpt(tmp_path_factory.mktemp("scene") / "excerpt")


def result(info, folder, stages) -> dict:
    return benchmark.run(info, folder, "excerpt", True, stages)


def test_the_front():
    rows = [Row("s", "a", 1, 1), Row("s", "b", 2, 0.5), Row("s", "c", 2, 1), Row("s", "d", 1.01, 1)]
    assert [on_front(row, rows) for row in rows] == [True, True, False, True]
    rows = [Row("s", "a", 1, 1, nbytes=10), Row("s", "b", 2, 1, nbytes=5), Row("s", "c", 2, 1, nbytes=10)]
    assert [on_front(row, rows) for row in rows] == [True, True, False]


@pytest.mark.slow
def test_kernels_and_their_variants(folder):
    info = choose_device()
    rows = result(info, folder, ["project", "tile lists", "sort", "composite"])["rows"]
    for stage in ("project", "tile lists", "sort", "composite"):
        own = [row for row in rows if row["stage"] == stage]
        assert [row["default"] for row in own].count(True) == 1
        assert all(row["seconds"] > 0 for row in own)
    default = {row["stage"]: row["error"] for row in rows if row["default"]}
    assert default["tile lists"] == default["sort"] == 0
    assert 0 < default["composite"] < 1e-4
    assert 0 < default["project"] < 1e-3
    assert any("sorts 4096" in row["variant"] for row in rows)


def test_ridge_errors_are_those_of_the_solution(plush_excerpt):
    scene = plush_excerpt.subset(np.arange(50))
    centres, weights = on_a_sphere(30), dense_weights(sparse_weights(50, 30))
    options = CompactionOptions(lam=0.1, alpha=1)
    compacted = Compactor(Device()).compact(scene, centres, weights, options)
    seen = np.diff(weights.offsets) > 0
    assert stage_variants.ridge_errors(scene, compacted, centres, weights, options).max() < 2e-6
    off = compacted.sh.copy()
    off[:, 0] += 0.01
    spoiled = dataclasses.replace(compacted, sh=off)
    errors = stage_variants.ridge_errors(scene, spoiled, centres, weights, options)
    assert len(errors) == seen.sum()
    # DC's basis value times the change of Y.
    scale = np.maximum(np.abs(channels(scene.sh)[seen]).max(axis=(1, 2)), 1)
    assert np.median(errors[:, 0]) == pytest.approx(0.0028 / np.median(scale), rel=0.3)


@pytest.mark.slow
def test_every_stage_on_the_excerpt(folder, capsys):
    found = result(choose_device(), folder, list(tradeoffs.STAGES))
    kept = json.loads(json.dumps(found))
    tradeoffs.print_report(kept)
    printed = capsys.readouterr().out
    for stage in tradeoffs.STAGES:
        own = [row for row in found["rows"] if row["stage"] == stage]
        assert len(own) > 3
        assert all(np.isfinite([row["seconds"], row["error"]]).all() for row in own)
        assert [row["default"] for row in own].count(True) == 1, stage
        assert f"#### {stage}: seconds" in printed


def test_the_views_of_a_workload(folder):
    load = stage_variants.Workload.of(folder, quick=True)
    assert len(load.some) == load.views
    assert camera_centres(load.some).shape == (load.views, 3)
    assert {c.split for c in load.train} == {"train"}
    assert {c.split for c in load.test} == {"test"}
