"""docs/benchmarks: no table and no plot disagrees with the results beside it, and the check sees it if one does."""

from __future__ import annotations

import json
import shutil

import pytest

from tools.make import benchmark_pages, benchmark_plots, benchmark_results
from tools.make.benchmark_results import Column, Result, ResultError, circumstances, load, table

CIRCUMSTANCES = {"title": "A", "machine": "an H200", "date": "2026-11-21", "command": (), "state": "current"}


def result(columns, rows, **more):
    return Result(**{**CIRCUMSTANCES, **more}, columns=tuple(columns), rows=tuple(map(tuple, rows)))


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the pages, their results and pictures, to be changed."""
    docs = tmp_path / "docs"
    docs.mkdir()
    for page in benchmark_pages.PAGES.parent.glob("*.md"):  # that links lead to
        shutil.copy(page, docs)
    pages = shutil.copytree(benchmark_pages.PAGES, docs / "benchmarks")
    images = shutil.copytree(benchmark_plots.IMAGES, docs / "images")
    monkeypatch.setattr(benchmark_pages, "PAGES", pages)
    monkeypatch.setattr(benchmark_pages, "RESULTS", pages / "results")
    monkeypatch.setattr(benchmark_plots, "IMAGES", images)
    return pages


def found(copy):
    return benchmark_pages.problems(load(copy / "results"))


def change(path, before, after):
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after, 1), encoding="utf-8")


def test_pages_and_plots_are_those_of_the_results():
    assert benchmark_pages.problems(load()) == []


def test_a_table_changed_by_hand_is_stale(copy):
    assert found(copy) == []
    size = load(copy / "results")["encode/stages"].values("bytes")[0]
    change(copy / "encode.md", f"| {size:,} |", f"| {size - 100_000:,} |")
    assert [line.split(": ")[1] for line in found(copy)] == ["stale, run python -m tools.make.benchmark_pages"]


def test_a_changed_result_makes_page_headline_and_plot_stale(copy):
    path = copy / "results" / "encode.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    names = [column["name"] for column in content["stages"]["columns"] if "ratio" not in column]
    for row in content["stages"]["rows"]:
        row[names.index("in all")] += 1
    path.write_text(json.dumps(content), encoding="utf-8")
    lines = "\n".join(found(copy))
    assert all(name in lines for name in ("encode.md", "README.md", "encode_presets.png"))
    assert "pruning_curves.png" not in lines


def test_a_changed_default_makes_pages_stale(copy, monkeypatch):
    now = benchmark_results.package_defaults()
    monkeypatch.setattr(benchmark_results, "package_defaults", lambda: {**now, "tolerance": 0.02})
    stale = {line.split(": ")[0].rsplit("/", 1)[-1] for line in found(copy)}
    assert {"encode.md", "pruning.md", "rate_distortion.md"} <= stale


@pytest.mark.parametrize(
    ("page", "text", "complaint"),
    [
        ("codec.md", "python -m tools.bench.nothing", "there is no module tools.bench.nothing"),
        ("codec.md", "[there](nowhere.md)", "the link nowhere.md leads to no file"),
        ("codec.md", "[there](encode.md#nowhere)", "the link encode.md#nowhere leads to no heading"),
    ],
)
def test_what_leads_nowhere(copy, page, text, complaint):
    path = copy / page
    path.write_text(path.read_text(encoding="utf-8") + f"\n{text}\n", encoding="utf-8")
    assert [line.split(": ", 1)[1] for line in found(copy)] == [complaint]


def test_results_that_no_page_shows_and_misplaced_history(copy):
    change(copy / "search.md", "<!-- table: search/cpu -->", "<!-- table: search/h200 -->")
    assert any("no page shows 'search/cpu'" in line for line in found(copy))
    path = copy / "results" / "search.json"
    raw = json.loads(path.read_text(encoding="utf-8"))
    raw["h200"]["state"] = "history"
    path.write_text(json.dumps(raw), encoding="utf-8")
    assert any("'search/h200' is history" in line for line in found(copy))


def test_a_page_that_asks_for_what_is_not_there(copy):
    change(copy / "search.md", "<!-- table: search/cpu -->", "<!-- table: search/gpu -->")
    with pytest.raises(ResultError, match="there is no result 'search/gpu'"):
        found(copy)


def test_cells():
    columns = [
        Column("scene"),
        Column("bytes", format=","),
        Column("whole", hidden=True),
        Column("times smaller", format=".1f", ratio=("whole", "bytes")),
        Column("time", format="time"),
        Column("both", unit="dB", format="{:.2f} / {:.1f}"),
        Column("all", unit="s", format="range"),
    ]
    rows = [
        ["lego", 12345, 50000, 0.0034, [1.5, -2], [2.2, 2.5]],
        ["plush", None, 1, 1.05, None, 1.7],
    ]
    assert table(result(columns, rows)).splitlines() == [
        "| scene | bytes | times smaller | time | both, dB | all, s |",
        "|---|---|---|---|---|---|",
        "| lego | 12,345 | 4.1 | 3.4 ms | 1.50 / -2.0 | 2.2 to 2.5 |",
        "| plush |  |  | 1.05 s |  | 1.7 |",
    ]
    assert table(result([Column("a"), Column("b")], [["x", 1], ["y", 2]], transpose=1)).splitlines() == [
        "|  | x | y |",
        "|---|---|---|",
        "| b | 1 | 2 |",
    ]


def test_the_default_is_the_package_s(monkeypatch):
    monkeypatch.setattr(benchmark_results, "package_defaults", lambda: {"iterations": 48, "tolerance": 0.01})
    columns = [Column("n", default="{iterations}"), Column("t", default="{tolerance:g}"), Column("best", bold=True)]
    lines = table(result(columns, [[48, 0.02, True], [48, 0.01, False], [24, 0.01, False]])).splitlines()
    assert lines[2:] == ["| **48** | 0.02 |", "| 48 | 0.01 (default) |", "| 24 | 0.01 |"]
    line = circumstances(result([Column("n")], [[1]], options={"tolerance": 0.002, "iterations": 48}, state="history"))
    assert line == ("*History: an H200, 2026-11-21. Measured with tile tolerance 0.002; the default is 0.01 now.*")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"rows": [[1, 2]]}, "row 1 has 2 cells, there are 1 columns"),
        ({"state": "new"}, "the state is 'new'"),
        ({"date": "yesterday"}, "the date is 'yesterday'"),
        ({"colour": 1}, "'colour' is no part of a result"),
        ({"columns": [{"name": "a", "width": 3}]}, "'width' is no part of a column"),
        ({"columns": [{"name": "a"}, {"name": "a"}]}, "two columns have the same name"),
    ],
)
def test_results_that_are_none(tmp_path, changes, complaint):
    good = {**CIRCUMSTANCES, "command": [], "columns": [{"name": "a"}], "rows": [[1]]}
    (tmp_path / "x.json").write_text(json.dumps({"y": good}), encoding="utf-8")
    assert load(tmp_path)["x/y"].values("a") == [1]
    (tmp_path / "x.json").write_text(json.dumps({"y": {**good, **changes}}), encoding="utf-8")
    with pytest.raises(ResultError, match=complaint):
        load(tmp_path)


def test_bytes_at_equal_psnr():
    rows = [{"PSNR against uncompressed": p, "size": s} for p, s in ((40.0, 1.0), (44.0, 4.0))]
    assert benchmark_plots.bytes_at(rows, 42.0) == pytest.approx(2.0)
