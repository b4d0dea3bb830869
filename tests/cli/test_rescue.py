"""A result that cannot be written in the end, hours after the command began: it is kept, and one line says where."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl import cli
from potr_cl.formats.scenes import ply
from tests.cli.calls import KEEP, fails

ROOT = Path(__file__).parents[2]
#: Drivers, which are loaded meanwhile, may have files of their own beside it.
KEPT = "potr-cl-kept-*"


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


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

    for command in ("encode", "prune", "compact"):
        cli.command_parser([command])  # imports it
    for module, name in (("encode", "encode"), ("edit", "prune"), ("edit", "compact")):
        remove_first(f"potr_cl.cli.{module}", name)
    return folder


def told_place(text: str) -> Path:
    found = re.search(r"the result is kept as '(.*?)': move it", text)
    assert found, text
    return Path(found[1])


def test_an_encode(tmp_path, scene_path, potr_path, gone, temporary, capsys):
    fails(capsys, ["encode", scene_path, "-o", gone / "a.potr", "--zstd-level", "1", *KEEP], 1, "is gone; the result")
    (folder,) = temporary.glob(KEPT)
    assert (folder / "a.potr").read_bytes() == potr_path.read_bytes()


def test_a_pruned_and_a_compacted_scene(tmp_path, scene_path, cameras_path, gone, temporary, capsys):
    views = ["--cameras", cameras_path]
    fails(capsys, ["prune", scene_path, *views, "-o", gone / "a.ply", "--count", "50", "--iterations", "2"], 2, "kept")
    (folder,) = temporary.glob(KEPT)
    assert len(ply.load(folder / "a.ply")) == 50
    gone.mkdir()
    fails(capsys, ["compact", scene_path, *views, "-o", gone / "b.spz"], 2, "does not exist; the result is kept")
    assert sorted(path.name for path in temporary.glob(f"{KEPT}/*")) == ["a.ply", "b.spz"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("reader", ["full", "gone"])
def test_standard_output(tmp_path, scene_path, potr_path, temporary, reader):
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
    kept = told_place(result.stderr)
    assert kept.suffix == ".potr"
    assert kept.read_bytes() == potr_path.read_bytes()


def test_from_python(tmp_path, scene_path, cameras_path, temporary):
    """The same for files that functions are asked to write besides."""
    folder = tmp_path / "gone"

    def called(work, name, *args, **keywords):
        folder.mkdir(exist_ok=True)
        with pytest.raises(potr_cl.WriteError) as caught:
            work(
                scene_path, *args, cameras_path, output=folder / name,
                progress=lambda what, done: shutil.rmtree(folder, ignore_errors=True), **keywords,
            )  # fmt: skip
        return told_place(str(caught.value))

    encoded = called(potr_cl.encode, "a.potr", preset="fast")
    assert encoded.read_bytes() == potr_cl.encode(scene_path, cameras_path, preset="fast").data
    assert len(ply.load(called(potr_cl.prune, "a.ply", count=50, iterations=2))) == 50
    assert len(ply.load(called(potr_cl.compact, "b.ply"))) == 200
    refitted = ply.load(called(potr_cl.refit, "c.ply", scene_path, steps=1))
    assert np.array_equal(refitted.means, ply.load(scene_path).means)


def test_a_report_that_cannot_be_written_takes_nothing_from_the_file(tmp_path, scene_path, cameras_path):
    (tmp_path / "gone").mkdir()
    with pytest.raises(potr_cl.WriteError, match=r"page\.html': the folder '.*gone' is gone$"):
        potr_cl.encode(
            scene_path, cameras_path, preset="fast", output=tmp_path / "a.potr", report=tmp_path / "gone" / "page.html",
            progress=lambda what, done: shutil.rmtree(tmp_path / "gone", ignore_errors=True),
        )  # fmt: skip
    assert len(potr_cl.decode(tmp_path / "a.potr")) > 0


def test_a_ladder(tmp_path, scene_path, temporary):
    """A quality that cannot be written is kept; so is the description, where it alone cannot."""
    folder = tmp_path / "ladder"
    plain = {"prune": False, "compact": False, "refit": "off"}
    for steps, name in (("0.2,0.8", "scene_q0.8.potr"), ("0.2", "ladder.json")):
        with pytest.raises(potr_cl.WriteError) as caught:
            potr_cl.encode_ladder(scene_path, folder, steps, tell=lambda line: shutil.rmtree(folder), **plain)
        kept = told_place(str(caught.value))
        assert kept.name == name
        if name.endswith(".potr"):
            assert len(potr_cl.decode(kept)) == 200
        else:
            assert [rung["q"] for rung in json.loads(kept.read_text())["rungs"]] == [0.2]


def test_a_folder_where_a_file_of_a_ladder_belongs_is_told_before_the_work(tmp_path, scene_path):
    (tmp_path / "ladder.json").mkdir()
    with pytest.raises(potr_cl.UsageError, match=r"ladder\.json': it is a directory"):
        potr_cl.encode_ladder(scene_path, tmp_path, "0.2", tell=pytest.fail)


def test_a_comparison_tells_its_figures_although_the_picture_cannot_be_written(
    tmp_path, scene_path, cameras_path, monkeypatch, capsys
):
    folder = tmp_path / "gone"
    folder.mkdir()
    cli.command_parser(["compare"])
    work = sys.modules["potr_cl.cli.pictures"].compare_scenes

    def instead(*args, **keywords):
        shutil.rmtree(folder)
        return work(*args, **keywords)

    monkeypatch.setattr("potr_cl.cli.pictures.compare_scenes", instead)
    call = ["compare", scene_path, scene_path, "--cameras", cameras_path, "--views", "0", "-o", folder / "a.png"]
    assert cli.main([str(word) for word in [*call, "--json"]]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out)["views"][0]["b_against_a"]["ssim"] == 1
    assert "is gone" in captured.err
