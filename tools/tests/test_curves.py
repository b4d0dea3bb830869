"""Points of several runs as one curve: the newest of each, and every commit by name."""

from __future__ import annotations

import json

import pytest

from potr_cl.errors import UsageError
from tools.study.curves import merged


def run(path, commit, scenes, machine="a", **points):
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
    a = run(tmp_path / "a", "aaaaaaa", ["s", "t"], best={0.5: 5, 0.1: 1}, fast={0.5: 6})
    b = run(tmp_path / "b", "bbbbbbb", ["s"], machine="b", best={0.3: 3, 0.5: 4})
    both = merged([a, b])
    points = both["scenes"]["s"]["series"]["best"]["encodes"]
    assert [(p["q"], p["bytes"], p["commit"]) for p in points] == [
        (0.1, 1, "aaaaaaa"),
        (0.3, 3, "bbbbbbb"),
        (0.5, 4, "bbbbbbb"),
    ]
    assert [p["bytes"] for p in both["scenes"]["t"]["series"]["best"]["encodes"]] == [1, 5]
    assert both["commit"] == "aaaaaaa (best, fast); bbbbbbb (best of s)"
    assert (both["machine"], both["date"]) == ("a; b", "2026-01-01")
    assert both["command"] == ["python aaaaaaa", "python bbbbbbb"]


def test_a_point_s_own_commit_counts(tmp_path):
    """A run that goes on where a file of another commit stops leaves points of both."""
    path = run(tmp_path / "a", "bbbbbbb", ["s"], best={0.1: 1, 0.5: 5})
    content = json.loads(path.read_text())
    content["scenes"]["s"]["series"]["best"]["encodes"][0]["commit"] = "aaaaaaa"
    path.write_text(json.dumps(content))
    assert merged([path])["commit"] == "aaaaaaa (best); bbbbbbb (best)"


def test_series_in_the_order_asked_for(tmp_path):
    a = run(tmp_path / "a", "aaaaaaa", ["s"], best={0.5: 5}, fast={0.5: 6}, paper={0.5: 7})
    b = run(tmp_path / "b", "aaaaaaa", ["t"], best={0.5: 5})
    both = merged([a, b], ["paper", "best"])
    assert [list(entry["series"]) for entry in both["scenes"].values()] == [["paper", "best"], ["best"]]
    assert both["commit"] == "aaaaaaa"
    c = run(tmp_path / "c", "ccccccc", ["s"], machine="c", other={0.5: 5})
    assert merged([a, b, c], ["paper", "best"])["machine"] == "a", "a file of which nothing is taken is named"
    with pytest.raises(UsageError, match="there is no series 'slow'"):
        merged([a, b], ["slow"])
