"""The tools about the fit, on an excerpt."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from potr_cl.model.camera import resized, test_views, train_views
from potr_cl.opencl.device import Device
from tools.bench import fit as bench
from tools.study import gauss_newton as study


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
    assert set(tables) == {"steps", "products", "errors"}
    (steps,) = tables["steps"]["rows"]
    assert steps[1] == 375
    assert min(steps[4:]) > 0
    rows = tables["errors"]["rows"]
    assert all(row[3] < 1e-5 for row in rows if row[1] * row[2] < 1)
    assert all(row[3] > 1e-2 for row in rows if row[1] * row[2] > 20), "what exceeds the fixed point is cut"


@pytest.mark.parametrize("family", ["cpu", "gpu"])
def test_levenberg_marquardt_does_what_it_promises(family, plush_excerpt, plush_excerpt_cameras):
    device = Device(family=family, variants=study.VARIANTS)
    cameras = [resized(camera, 120, 90) for camera in plush_excerpt_cameras]
    train, test = train_views(cameras), test_views(cameras)
    pruned = plush_excerpt.subset(np.arange(0, 1500, 2))
    race = study.Race(device, plush_excerpt, pruned, train, test)
    rows = race.run(1e9, [1e-9, 2e-9], study.gauss_newton(race, study.Trust(batch=9, steps=6)))
    first, *_, last = rows
    assert last[2] > first[2] + 3, "training views"
    assert last[3] > first[3] + 2, "test views"
    assert device.allocated == 0
