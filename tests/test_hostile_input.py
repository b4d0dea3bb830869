"""Short runs of the tools that attack the package; docs/benchmarks/hostile_input.md has long ones.

Changed files and bombs to every reader, signals to commands that write, every command twice. The tools run in processes
of their own, which what is wrong may end.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the tools look into /proc")

ROOT = Path(__file__).parents[1]
#: Formats, and the module that reading them needs besides the package's own.
FORMATS = {
    "potr": None,
    "ply": None,
    "compressed.ply": "gsply",
    "spz": None,
    "sog": None,
    "sog-folder": None,
    "sog-levels": None,
    "glb": None,
    "gltf": None,
    "splat": None,
    "ksplat": None,
    "ply.gz": None,
    "cameras.json": None,
    "transforms.json": None,
    "colmap-binary": None,
    "colmap-text": None,
    "png": None,
    "jpeg": None,
    "webp": None,
}


@pytest.fixture(params=FORMATS)
def form(request) -> str:
    needed = FORMATS[request.param]
    if needed is not None and importlib.util.find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed")
    return request.param


def run(tool: str, tmp_path: Path, *arguments: str) -> list[dict[str, Any]]:
    """The rows of a tool's only result, by columns' names; fails where the tool found something."""
    command = [sys.executable, "-m", f"tools.stress.{tool}", *arguments, "--json", str(tmp_path / "result.json")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    (result,) = json.loads((tmp_path / "result.json").read_text()).values()
    names = [column["name"] for column in result["columns"]]
    return [dict(zip(names, row, strict=True)) for row in result["rows"]]


def attack(form: str, tmp_path: Path, count: int, seed: int) -> None:
    findings = tmp_path / "findings"
    arguments = ["--format", form, "--count", str(count), "--seed", str(seed), "--findings", str(findings)]
    (row,) = run("fuzz", tmp_path, *arguments)
    assert row["files"] == row["read"] + row["refused"] == count
    assert row["findings"] == 0
    # Both must occur, else the changes test nothing.
    assert row["refused"] > count / 10
    assert row["read"] > count / 50


def test_some_changed_files(form, tmp_path):
    attack(form, tmp_path, 300, 1)


@pytest.mark.slow
def test_many_changed_files(form, tmp_path):
    """Most of all of the format that is our own; campaigns go further (docs/benchmarks/hostile_input.md)."""
    attack(form, tmp_path, 10_000 if form == "potr" else 2_500, 11)


def test_bombs(form, tmp_path):
    rows = run("bombs", tmp_path, "--format", form)
    assert {row["format"] for row in rows} == {form}
    assert {row["outcome"] for row in rows} <= {"read", "refused"}


def test_some_messages_to_the_viewer(tmp_path):
    pytest.importorskip("viser", reason="the extra view is not installed")
    (row,) = run("page", tmp_path, "--count", "2000", "--tabs", "2")
    assert row["bytes printed"] == 0
    assert row["answers to the honest tab"] > 0


def signals(tmp_path: Path, moments: int, *commands: str) -> None:
    names = [argument for name in commands for argument in ("--command", name)]
    rows = run("signals", tmp_path, "--moments", str(moments), *names)
    assert sum(row["moments"] for row in rows) == moments
    assert sum(row["wrong"] for row in rows) == 0
    assert sum(row["ended by the signal"] for row in rows) > 0


def test_some_signals(tmp_path):
    signals(tmp_path, 6, "decode")


@pytest.mark.slow
def test_signals_to_every_command(tmp_path):
    signals(tmp_path, 56)


def twice(tmp_path: Path, *commands: str) -> None:
    rows = run("determinism", tmp_path, *[argument for name in commands for argument in ("--command", name)])
    assert {row["same bytes"] for row in rows} == {"yes"}


@pytest.mark.slow
def test_files_are_the_same_the_second_time(tmp_path):
    twice(tmp_path, "decode", "convert to spz")


@pytest.mark.slow
def test_every_file_is_the_same_the_second_time(tmp_path):
    twice(tmp_path)
