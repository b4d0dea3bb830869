"""The benchmark of presets, on next to nothing."""

from __future__ import annotations

import json
import sys

import pytest

from tools.bench import presets
from tools.workloads import excerpt


def test_a_row_a_preset_with_all_its_seconds(tmp_path, monkeypatch):
    folder, kept = excerpt(tmp_path / "excerpt"), tmp_path / "kept.json"
    arguments = [str(folder), "--presets", "fast", "best", "--runs", "1", "--json", str(kept), "--seconds"]
    monkeypatch.setattr(sys, "argv", ["presets", *arguments, "1e-9"])
    presets.main()
    assert not kept.exists(), "a preset began after the time was over"

    told = {"bytes": 7, "quality": {"psnr": 40.0}, "seconds": {"prune": 1, "refit": 2, "evaluate": 4, "total": 8}}
    times = iter((99.0, 43.0, 99.0, 42.0))  # the first of each preset is not counted
    monkeypatch.setattr(presets, "clocked", lambda work: (next(times), json.dumps(told)))
    monkeypatch.setattr(sys, "argv", ["presets", *arguments, "1e9"])
    presets.main()
    commands = json.loads(kept.read_text())["commands"]["rows"]
    assert commands == [["excerpt", preset, 7, 40.0, 3, 8, s] for preset, s in (("fast", 43), ("best", 42))]
    table = json.loads(kept.read_text())["stages"]
    heads = [column["name"] for column in table["columns"]]
    fast, best = (dict(zip(heads, row, strict=True)) for row in table["rows"])
    assert (fast["scene"], fast["preset"], best["preset"]) == ("excerpt", "fast", "best")
    assert fast["bytes"] > best["bytes"], "fast is as small as best"
    assert fast["PLY bytes"] == (folder / "point_cloud.ply").stat().st_size
    for row in (fast, best):
        assert sum(row[stage] for stage in presets.STAGES) == pytest.approx(row["in all"])
        assert min(row[stage] for stage in ("prepare views", "prune", "compact or re-fit")) > 0
        assert row["fit"] == 0
    assert (fast["the whole command"], best["the whole command"]) == (43, 42)
