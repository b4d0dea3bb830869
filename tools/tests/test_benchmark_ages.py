"""The list of tables by age: what has changed since a table was measured comes first, and nothing is made up."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tools.make import benchmark_ages, benchmark_pages
from tools.make.benchmark_ages import ages
from tools.make.benchmark_results import Result


def result(date="2026-01-02", commit="", state="current"):
    return Result("A", "an H200", date, (), state, (), (), commit=commit)


@pytest.fixture
def commits(tmp_path, monkeypatch):
    """A repository whose second and fourth commit change the package; the names of its commits."""

    def git(*arguments, day=1):
        when = f"2026-01-0{day} 12:00:00 +0000"
        environment = {f"GIT_{who}_{what}": "x" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
        environment |= {"GIT_AUTHOR_DATE": when, "GIT_COMMITTER_DATE": when, "PATH": "/usr/bin:/bin"}
        done = subprocess.run(["git", "-C", tmp_path, *arguments], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    git("init", "-q")
    (tmp_path / "potr_cl").mkdir()
    names = []
    for day, file in enumerate(("README.md", "potr_cl/a.py", "README.md", "potr_cl/b.py"), 1):
        (tmp_path / file).write_text(str(day))
        git("add", ".")
        git("commit", "-q", "-m", file, day=day)
        names.append(git("rev-parse", "HEAD"))
    monkeypatch.setattr(benchmark_ages, "ROOT", tmp_path)
    benchmark_ages._changes_since.cache_clear()
    benchmark_ages._last_of_day.cache_clear()
    return names


def test_the_most_outdated_come_first(commits):
    first, _, third, last = commits
    results = {
        "a/new": result(commit=last[:7]),
        "a/old": result(commit=first),
        "a/between": result(commit=f"{third[:10]}-dirty"),
        "a/of_two": result(commit=f"{last[:7]} (the GPU), {first[:7]} (the CPU)"),
        "a/by_date": result(date="2026-01-02, 2026-01-03"),
        "a/elsewhere": result(commit="0123456789"),
        "a/neither": result(date=""),
        "a/history": result(commit=first, state="history"),
    }
    found = ages(results)
    assert [(age.name, age.changes) for age in found] == [
        ("a/elsewhere", None),
        ("a/neither", None),
        ("a/of_two", 2),
        ("a/old", 2),
        ("a/between", 1),
        ("a/by_date", 1),
        ("a/new", 0),
    ]
    assert found[2].commits == (last[:7], first[:7])


def test_without_git_nothing_is_known(monkeypatch, tmp_path):
    monkeypatch.setattr(benchmark_ages, "ROOT", tmp_path / "no repository")
    benchmark_ages._changes_since.cache_clear()
    assert [age.changes for age in ages({"a/b": result(commit="0123456")})] == [None]


def test_the_list_names_each_table_and_its_place(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark_pages", "--ages"])
    benchmark_pages.main()
    lines = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[1:]]
    named = {line[3]: line[4] for line in lines}
    assert named["rate_distortion/lego"] == "rate_distortion.md#size-and-quality-lego"
    assert all(named.values())
    assert not any(name.startswith("history/") for name in named)
