"""Short runs of the tools that attack the package; docs/benchmarks/hostile_input.md has long ones.

Changed files and bombs to every reader, every command twice. The tools run in processes of their own, which what is
wrong may end.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the tools look into /proc")

ROOT = Path(__file__).parents[1]
#: Formats whose files are attacked: those of the quick subset, and the others.
QUICK = ["potr", "ply", "spz", "transforms.json", "png"]
OTHERS = [
    "compressed.ply", "sog", "sog-folder", "sog-levels", "glb", "gltf", "splat", "ksplat", "html", "ply.gz",
    "cameras.json", "colmap-binary", "colmap-text", "jpeg", "webp",
]  # fmt: skip


def run(tool: str, tmp_path: Path, *arguments: str) -> list[dict[str, Any]]:
    """The rows of a tool's only result, by columns' names; fails where the tool found something."""
    command = [sys.executable, "-m", f"tools.stress.{tool}", *arguments, "--json", str(tmp_path / "result.json")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    (result,) = json.loads((tmp_path / "result.json").read_text()).values()
    names = [column["name"] for column in result["columns"]]
    return [dict(zip(names, row, strict=True)) for row in result["rows"]]


def each(option: str, names: list[str]) -> list[str]:
    return [word for name in names for word in (option, name)]


@pytest.mark.parametrize(
    ("formats", "count", "seed"),
    [(QUICK, 60, 1), pytest.param(["potr", *OTHERS], 150, 11, marks=pytest.mark.slow)],
    ids=["some", "many"],
)
def test_changed_files(formats, count, seed, tmp_path):
    """Campaigns go further (docs/benchmarks/hostile_input.md)."""
    arguments = ["--count", str(count), "--seed", str(seed), "--findings", str(tmp_path / "findings")]
    rows = run("fuzz", tmp_path, *each("--format", formats), *arguments)
    assert [row["format"] for row in rows] == formats
    for row in rows:
        assert row["files"] == row["read"] + row["refused"] == count, row
        assert row["findings"] == 0
        # Both must occur, else the changes test nothing.
        assert row["refused"] > count / 10, row
        assert row["read"] > count / 50, row


@pytest.mark.parametrize(
    "formats", [OTHERS[:1], pytest.param([*QUICK, *OTHERS[1:]], marks=pytest.mark.slow)], ids=["quick", "others"]
)
def test_bombs(formats, tmp_path):
    rows = run("bombs", tmp_path, *each("--format", formats))
    assert {row["format"] for row in rows} == set(formats)
    assert {row["outcome"] for row in rows} <= {"read", "refused"}


@pytest.mark.slow
def test_files_are_the_same_the_second_time(tmp_path):
    commands = ["encode --max-size", "decode", "convert to spz"]
    rows = run("determinism", tmp_path, *each("--command", commands))
    assert {row["command"]: row["same bytes"] for row in rows} == dict.fromkeys(commands, "yes")
