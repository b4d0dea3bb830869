"""A result that cannot be written in the end: one line says so."""

from __future__ import annotations

import importlib
import json
import shutil

import pytest

import potr_cl
from potr_cl import cli
from tests.cli.calls import KEEP, fails


@pytest.fixture
def gone(tmp_path, monkeypatch):
    """A folder that is removed once the work of a command has begun."""
    folder = tmp_path / "gone"
    folder.mkdir()

    def remove_first(module, name):
        work = getattr(importlib.import_module(module), name)

        def instead(*args, **keywords):
            shutil.rmtree(folder)
            return work(*args, **keywords)

        monkeypatch.setattr(f"{module}.{name}", instead)

    for name in ("encoder.run_stages", "editing.log_forecast", "comparing.compare_scenes"):
        remove_first(*f"potr_cl.api.{name}".rsplit(".", 1))
    return folder


def test_a_folder_that_is_gone(tmp_path, scene_path, cameras_path, gone, capsys):
    fails(capsys, ["encode", scene_path, "-o", gone / "a.potr", *KEEP], 1, "is gone")
    gone.mkdir()
    views = ["--cameras", cameras_path]
    fails(capsys, ["prune", scene_path, *views, "-o", gone / "a.ply", "--count", "50", "--iterations", "2"], 2, "exist")
    assert not gone.exists()


def test_a_report_that_cannot_be_written_takes_nothing_from_the_file(tmp_path, scene_path, cameras_path):
    (tmp_path / "gone").mkdir()
    with pytest.raises(potr_cl.WriteError, match=r"page\.html': the folder '.*gone' is gone$"):
        potr_cl.encode(
            scene_path, cameras_path, preset="fast", output=tmp_path / "a.potr", report=tmp_path / "gone" / "page.html",
            progress=lambda what, done: shutil.rmtree(tmp_path / "gone", ignore_errors=True),
        )  # fmt: skip
    assert len(potr_cl.decode(tmp_path / "a.potr")) > 0


def test_a_folder_where_a_file_of_a_ladder_belongs_is_told_before_the_work(tmp_path, scene_path):
    (tmp_path / "ladder.json").mkdir()
    with pytest.raises(potr_cl.UsageError, match=r"ladder\.json': it is a directory"):
        potr_cl.encode_ladder(scene_path, tmp_path, "0.2", progress=pytest.fail)


def test_a_comparison_tells_its_figures_although_the_picture_cannot_be_written(scene_path, cameras_path, gone, capsys):
    call = ["compare", scene_path, scene_path, "--cameras", cameras_path, "--views", "0", "-o", gone / "a.png"]
    assert cli.main([str(word) for word in [*call, "--json"]]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out)["views"][0]["b_against_a"]["ssim"] == 1
    assert "is gone" in captured.err
