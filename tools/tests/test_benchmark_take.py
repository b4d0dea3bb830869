"""What a tool has measured becomes a result of docs/benchmarks: new figures under the page's own decisions."""

from __future__ import annotations

import json
import sys

import pytest

from tools.make import benchmark_take
from tools.make.benchmark_results import load

NEW = {
    "title": "New", "machine": "an H200", "date": "2026-02-02", "command": ["python /here/a"], "commit": "abc1234",
    "columns": [{"name": "q", "format": ".1f"}, {"name": "whole"}, {"name": "bytes", "format": ","}],
    "rows": [[0.5, 50, 10], [0.7, 50, 25]],
}  # fmt: skip
OLD = {
    "title": "Old", "machine": "another", "date": "2026-01-01", "command": ["python a"], "state": "current",
    "remark": "Of before.",
    "columns": [
        {"name": "q", "default": "{quality:g}"}, {"name": "whole", "hidden": True},
        {"name": "times", "format": ".1f", "ratio": ["whole", "bytes"]}, {"name": "bytes", "unit": "B"},
    ],
    "rows": [[0.5, 40, 20]],
}  # fmt: skip


@pytest.fixture
def call(tmp_path, monkeypatch):
    """Takes tables into a folder of results."""
    monkeypatch.setattr(benchmark_take, "RESULTS", tmp_path)

    def take(*arguments, tables=None):
        (tmp_path / "new").mkdir(exist_ok=True)
        source = tmp_path / "new" / "tables.json"
        source.write_text(json.dumps(tables or {"t": NEW}))
        monkeypatch.setattr(sys, "argv", ["benchmark_take", str(source), *arguments])
        benchmark_take.main()
        return load(tmp_path)

    return take


def test_figures_are_new_and_the_page_s_decisions_stay(call, tmp_path):
    (tmp_path / "x.json").write_text(json.dumps({"t": OLD, "u": OLD}, indent=1) + "\n")
    results = call("x", "--command", "python -m tools.a SCENE")
    new = results["x/t"]
    assert (new.title, new.date, new.commit, new.machine) == ("Old", "2026-02-02", "abc1234", "an H200")
    assert (new.command, new.remark) == (("python -m tools.a SCENE",), "Of before.")
    assert [c.name for c in new.columns] == ["q", "whole", "times", "bytes"]
    assert new.column("whole").hidden
    assert (new.column("q").default, new.column("q").format) == ("{quality:g}", ".1f")
    assert new.values("times") == [5, 2]
    assert results["x/u"].values("bytes") == [20], "another result changed"


def test_names_titles_and_remarks(call, tmp_path):
    (tmp_path / "x.json").write_text(json.dumps({"t": OLD}, indent=1) + "\n")
    results = call("x", "t", "t=v", "--retitle", "--remark", "", "--commit", "one, two")
    assert (results["x/t"].title, results["x/t"].remark, results["x/t"].commit) == ("New", "", "one, two")
    assert results["x/v"].values("bytes") == [10, 25]
    assert call("y")["y/t"].title == "New", "a file that was not there"


@pytest.mark.parametrize(
    "style",
    [
        lambda content: json.dumps(content, indent=1, ensure_ascii=False) + "\n",
        lambda content: json.dumps(content, indent=1) + "\n",
        lambda content: benchmark_take._written(content, "{}"),
    ],
)
def test_what_is_not_taken_stays_as_it_was_written(call, tmp_path, style):
    path = tmp_path / "x.json"
    path.write_text(style({"u": {**OLD, "title": "µs"}, "t": OLD}), encoding="utf-8")
    before = path.read_text(encoding="utf-8").splitlines()
    call("x")
    after = path.read_text(encoding="utf-8").splitlines()
    untouched = next(i for i, line in enumerate(before) if '"t"' in line)
    assert after[:untouched] == before[:untouched]


def test_what_cannot_be_taken(call, tmp_path):
    with pytest.raises(SystemExit, match="there is no table 'v', expected one of t"):
        call("x", "v")
    (tmp_path / "x.json").write_text(json.dumps({"t": OLD}))
    before = (tmp_path / "x.json").read_text()
    thinner = {**NEW, "columns": NEW["columns"][:2], "rows": [[0.5, 50]]}
    with pytest.raises(SystemExit, match="has no column 'bytes', which another is derived from"):
        call("x", tables={"t": thinner})
    twice = {**NEW, "columns": [NEW["columns"][0], *NEW["columns"]], "rows": [[1, 2, 3, 4]]}
    with pytest.raises(SystemExit, match="two columns have the same name"):
        call("x", "t=new", tables={"t": twice})
    assert (tmp_path / "x.json").read_text() == before
