"""A result that cannot be written in the end: one line says so."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import potr_cl
from potr_cl import cli
from tests.cli.calls import KEEP, fails

ROOT = Path(__file__).parents[2]


@pytest.fixture
def gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is removed once the work of a command has begun."""
    folder = tmp_path / "gone"
    folder.mkdir()

    def remove_first(module: str, name: str) -> None:
        work = getattr(sys.modules[module], name)

        def instead(*args: object, **keywords: object) -> object:
            shutil.rmtree(folder)
            return work(*args, **keywords)

        monkeypatch.setattr(f"{module}.{name}", instead)

    for command in ("encode", "prune"):
        cli.command_parser([command])  # imports it
    for name in ("encoder.run_stages", "editing.log_forecast"):
        remove_first(*f"potr_cl.api.{name}".rsplit(".", 1))
    return folder


def test_a_folder_that_is_gone(tmp_path, scene_path, cameras_path, gone, capsys):
    fails(capsys, ["encode", scene_path, "-o", gone / "a.potr", *KEEP], 1, "is gone")
    gone.mkdir()
    views = ["--cameras", cameras_path]
    fails(capsys, ["prune", scene_path, *views, "-o", gone / "a.ply", "--count", "50", "--iterations", "2"], 2, "exist")
    assert not gone.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("reader", ["full", "gone"])
def test_standard_output(scene_path, reader):
    """The disk behind a pipe is full, or whoever reads it has ended."""
    if reader == "full":
        output = os.open("/dev/full", os.O_WRONLY)
    else:
        read, output = os.pipe()
        os.close(read)
    result = subprocess.run(
        [sys.executable, "-m", "potr_cl", "encode", str(scene_path), "-o", "-", "--zstd-level", "1", *KEEP],
        stdout=output, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    os.close(output)
    assert result.returncode == 1
    assert result.stderr.count("potr-cl: ") == 1
    assert "Traceback" not in result.stderr
    assert "cannot write to standard output" in result.stderr


def test_a_report_that_cannot_be_written_takes_nothing_from_the_file(tmp_path, scene_path, cameras_path):
    (tmp_path / "gone").mkdir()
    with pytest.raises(potr_cl.WriteError, match=r"page\.html': the folder '.*gone' is gone$"):
        potr_cl.encode(
            scene_path, cameras_path, preset="fast", output=tmp_path / "a.potr", report=tmp_path / "gone" / "page.html",
            progress=lambda what, done: shutil.rmtree(tmp_path / "gone", ignore_errors=True),
        )  # fmt: skip
    assert len(potr_cl.decode(tmp_path / "a.potr")) > 0


@pytest.mark.slow
def test_a_folder_where_a_file_of_a_ladder_belongs_is_told_before_the_work(tmp_path, scene_path):
    (tmp_path / "ladder.json").mkdir()
    with pytest.raises(potr_cl.UsageError, match=r"ladder\.json': it is a directory"):
        potr_cl.encode_ladder(scene_path, tmp_path, "0.2", progress=pytest.fail)


def test_a_comparison_tells_its_figures_although_the_picture_cannot_be_written(
    tmp_path, scene_path, cameras_path, monkeypatch, capsys
):
    folder = tmp_path / "gone"
    folder.mkdir()
    cli.command_parser(["compare"])
    work = sys.modules["potr_cl.api.comparing"].compare_scenes

    def instead(*args, **keywords):
        shutil.rmtree(folder)
        return work(*args, **keywords)

    monkeypatch.setattr("potr_cl.api.comparing.compare_scenes", instead)
    call = ["compare", scene_path, scene_path, "--cameras", cameras_path, "--views", "0", "-o", folder / "a.png"]
    assert cli.main([str(word) for word in [*call, "--json"]]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out)["views"][0]["b_against_a"]["ssim"] == 1
    assert "is gone" in captured.err
