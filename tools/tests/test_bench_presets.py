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

    monkeypatch.setattr(presets, "clocked", lambda work: (42.0, ""))
    monkeypatch.setattr(sys, "argv", ["presets", *arguments, "1e9"])
    presets.main()
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
        assert row["the whole command"] == 42
