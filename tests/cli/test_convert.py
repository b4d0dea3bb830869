"""The command convert."""

from __future__ import annotations

import shutil

import pytest

from potr_cl.cli import main
from potr_cl.formats.scenes import ply

pytest.importorskip("gsply", reason="the extra convert is not installed")


def test_convert_there_and_back(tmp_path, data, plush_excerpt, capsys):
    potr, small, back = tmp_path / "a.potr", tmp_path / "a.spz", tmp_path / "b.ply"
    assert main(["convert", str(data / "plush_excerpt.ply"), str(small)]) == 0
    assert "1,500 splats" in capsys.readouterr().out
    encode = ["encode", str(small), "-o", str(potr), "--no-prune", "--refit", "off", "--no-compact", "--no-quality"]
    assert main(encode) == 0
    assert main(["convert", str(potr), str(back)]) == 0
    assert len(ply.load(back)) == 1500


@pytest.mark.parametrize(
    ("output", "said"),
    [("a.potr", "command encode"), ("a.ksplat", "written as"), ("a", "written as"), ("no/a.spz", "does not exist")],
)
def test_convert_tells_what_it_cannot_do(tmp_path, data, capsys, output, said):
    assert main(["convert", str(data / "plush_excerpt.ply"), str(tmp_path / output)]) == 2
    assert said in capsys.readouterr().err


def test_convert_does_not_replace_its_input(tmp_path, data, capsys):
    shutil.copy(data / "plush_excerpt.ply", tmp_path / "a.ply")
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.ply")]) == 2
    assert "would be replaced" in capsys.readouterr().err
