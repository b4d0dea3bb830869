"""The command convert."""

from __future__ import annotations

from potr_cl.cli import main
from potr_cl.formats.scenes import ply


def test_convert_there_and_back(tmp_path, data, plush_excerpt, capsys):
    potr, small, back = tmp_path / "a.potr", tmp_path / "a.spz", tmp_path / "b.ply"
    assert main(["convert", str(data / "plush_excerpt.ply"), str(small)]) == 0
    assert "1,500 splats" in capsys.readouterr().out
    encode = ["encode", str(small), "-o", str(potr), "--no-prune", "--refit", "off", "--no-compact", "--no-quality"]
    assert main(encode) == 0
    assert main(["convert", str(potr), str(back)]) == 0
    assert len(ply.load(back)) == 1500
