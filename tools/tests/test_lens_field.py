"""The study of views that stand for distorted photographs: it runs, and its table says what it measured."""

from __future__ import annotations

import shutil
import sys

import pytest

from tools.study import lens_field


@pytest.mark.parametrize("k1", [-0.15, 0.1])
def test_table(monkeypatch, tmp_path, data, capsys, k1):
    shutil.copy(data / "lego_excerpt.ply", tmp_path / "point_cloud.ply")
    shutil.copy(data / "lego_cameras.json", tmp_path / "cameras.json")
    monkeypatch.setattr(sys, "argv", ["lens_field", str(tmp_path), "--divide", "8", "--k1", str(k1)])
    lens_field.main()
    head, _, _, _, *rows = capsys.readouterr().out.splitlines()
    outside = float(head.partition(" %")[0])
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[0] for row in cells] == ["pinhole part", "filled", "covering"]
    sizes = {row[0]: int(row[1].split(" x ")[0]) for row in cells}
    assert sizes["filled"] <= sizes["covering"]
    assert sizes["pinhole part"] == 50
    # A barrel shows what the pinhole part does not; there the excerpt has nothing, so that all pictures are alike.
    assert (outside > 0) == (k1 < 0)
    for row in cells:
        assert all(30 < float(number) < 80 for number in row[3:5])
        assert row[5] == ("identical" if outside else "-")
