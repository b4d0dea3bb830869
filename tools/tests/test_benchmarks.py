"""docs/benchmarks: no table and no plot disagrees with the results beside it, and the check sees it if one does."""

from __future__ import annotations

import json
import shutil

import pytest

from tools.make import benchmarks
from tools.make.benchmarks import _GPU, ResultError, figures_table, load


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the pages and their results, to be changed."""
    pages = shutil.copytree(benchmarks.PAGES, tmp_path / "benchmarks")
    monkeypatch.setattr(benchmarks, "PAGES", pages)
    monkeypatch.setattr(benchmarks, "RESULTS", pages / "results")
    return pages


def change(path, before, after):
    text = path.read_text("utf-8")
    assert before in text
    path.write_text(text.replace(before, after, 1), "utf-8")


def test_pages_and_plots_are_those_of_the_results():
    assert benchmarks.problems(load()) == []


def test_a_table_changed_by_hand_is_stale(copy):
    size = load()["encode/stages"].records()[0]["bytes"]
    change(copy / "encode.md", f"| {size:,} |", f"| {size - 100_000:,} |")
    assert [line.split(": ")[1] for line in benchmarks.problems(load())] == [
        "stale, run python -m tools.make.benchmarks"
    ]


def test_a_changed_result_makes_page_and_plot_stale(copy):
    path = copy / "results" / "rate_distortion.json"
    content = json.loads(path.read_text("utf-8"))
    for row in content["lego"]["rows"]:
        row[3] *= 2
    path.write_text(json.dumps(content), "utf-8")
    lines = "\n".join(benchmarks.problems(load()))
    assert all(name in lines for name in ("rate_distortion.md", "rate_distortion_photographs.png"))
    assert "images/photographs.png" not in lines


def test_results_that_no_page_shows_or_that_are_not_there(copy):
    change(copy / "ablation.md", "<!-- table: ablation/lego -->", "<!-- table: ablation/plush -->")
    assert any("no page shows 'ablation/lego'" in line for line in benchmarks.problems(load()))
    change(copy / "ablation.md", "<!-- table: ablation/plush -->", "<!-- table: ablation/bicycle -->")
    with pytest.raises(ResultError, match="there is no result 'ablation/bicycle'"):
        benchmarks.problems(load())


def test_what_a_tool_kept_is_taken_and_keeps_its_title(copy, tmp_path):
    before = load()["ablation/lego"]
    content = json.loads((copy / "results" / "ablation.json").read_text("utf-8"))
    kept = {**content["lego"], "title": "another", "rows": content["lego"]["rows"][:2]}
    (tmp_path / "kept.json").write_text(json.dumps({"excerpt": kept}))
    benchmarks.take(tmp_path / "kept.json", "ablation", ["excerpt=lego"], "Two rows.")
    after = load()["ablation/lego"]
    assert (after.title, after.rows, after.remark) == (before.title, before.rows[:2], "Two rows.")
    assert load()["ablation/plush"].markdown() in (copy / "ablation.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"rows": [[1, 2]]}, "row 1 has 2 cells, there are 1 columns"),
        ({"colour": 1}, "colour"),
        ({"columns": [{"name": "a", "width": 3}]}, "width"),
    ],
)
def test_results_that_are_none(tmp_path, changes, complaint):
    good = {"title": "A", "machine": "m", "date": "", "command": [], "columns": [{"name": "a"}], "rows": [[1]]}
    (tmp_path / "x.json").write_text(json.dumps({"y": good}), "utf-8")
    assert load(tmp_path)["x/y"].row(a=1) == {"a": 1}
    (tmp_path / "x.json").write_text(json.dumps({"y": {**good, **changes}}), "utf-8")
    with pytest.raises(ResultError, match=complaint):
        load(tmp_path)


def test_the_figures_are_of_the_results():
    commands = load()["whole_commands/commands"].records()
    for row in (row for row in commands if row["device"] == _GPU):
        assert f"| {row['bytes'] / 1e6:.2f} MB |" in figures_table()
