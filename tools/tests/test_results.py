"""What every tool shares: results that say what they are of, views at another resolution."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl.raster.rules import INRIA
from tests.reference import raster as reference
from tests.reference.scenes import random_splats, ring_of_cameras
from tools.results import ROOT, Column, Results, circumstances, write_json
from tools.workloads import best_of, scaled


def test_a_table_is_printed_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "results.json"
    results = Results(None, path)
    columns = Column("stage"), Column("wall", "ms", ".1f"), Column("share", format=".0%")
    stages = results.table("stages", "The stages", *columns)
    stages.add("prune", 731.23, 0.5)
    other = results.table("both", "Two in a cell", Column("times", "s", "{:.1f} / {:.2f}"))
    other.add([1.25, 2.5])
    stages.add("all", 1462.5, None)
    with pytest.raises(ValueError, match="zip"):
        stages.add("too few cells")
    printed = capsys.readouterr().out
    assert "\nThe stages:\n\n| stage | wall, ms | share |\n|---|---|---|\n| prune | 731.2 | 50% |\n" in printed
    assert "| 1.2 / 2.50 |" in printed
    assert printed.endswith("| all | 1462.5 |  |\n")

    kept = json.loads(path.read_text())
    assert list(kept) == ["stages", "both"]
    assert kept["stages"].keys() == {"title", "machine", "date", "command", "commit", "columns", "rows"}
    assert kept["stages"]["title"] == "The stages"
    wall, share = {"name": "wall", "unit": "ms", "format": ".1f"}, {"name": "share", "format": ".0%"}
    assert kept["stages"]["columns"] == [{"name": "stage"}, wall, share]
    assert kept["stages"]["rows"] == [["prune", 731.23, 0.5], ["all", 1462.5, None]]


def test_what_json_cannot_hold(tmp_path: Path) -> None:
    """A table keeps it as text; where a tool's own content has it, the file that was there stays whole."""
    path = tmp_path / "results.json"
    Results(None, path).table("t", "A table", Column("PSNR", "dB", ".1f")).add(float("inf"))
    assert json.loads(path.read_text())["t"]["rows"] == [["inf"]]
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"psnr": float("nan")})
    assert json.loads(path.read_text())["t"]["rows"] == [["inf"]]


def test_a_result_knows_its_command(tmp_path: Path) -> None:
    (tmp_path / "some_tool.py").write_text(
        "from tools.results import circumstances\nprint(circumstances()['command'][0])\n"
    )
    run = subprocess.run(
        [sys.executable, "-m", "some_tool", "--scene", "a b"], env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout == "python -m some_tool --scene 'a b'\n"


def test_a_result_knows_its_commit() -> None:
    about = circumstances()
    assert about["machine"].endswith("processors")
    try:
        head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        assert about["commit"] == "unknown"
    else:
        assert head.stdout.startswith(about["commit"].removesuffix("-dirty"))


def test_views_at_another_resolution_show_the_same() -> None:
    camera = dataclasses.replace(ring_of_cameras(3, size=47)[1], cx=20.0)
    half = scaled(camera, 0.5)
    assert (half.width, half.height) == (23, 23)
    whole, small = (reference.project(random_splats(40, seed=5), c, INRIA) for c in (camera, half))
    np.testing.assert_allclose(small.centre, whole.centre * 23 / 47)
    assert scaled(camera, 1e-3).width == 1


def test_the_first_run_does_not_count() -> None:
    runs: list[int] = []
    assert best_of(2, lambda: runs.append(1)) >= 0
    assert len(runs) == 3
