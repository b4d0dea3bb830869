"""The study of views that stand for distorted photographs: it runs, and its table says what it measured."""

from __future__ import annotations

import json
import shutil
import sys

import pytest

from tools.study import lens_field


@pytest.mark.slow
@pytest.mark.parametrize("k1", [-0.15, 0.1])
def test_table(monkeypatch, tmp_path, data, capsys, k1):
    shutil.copy(data / "plush_excerpt.ply", tmp_path / "point_cloud.ply")
    views = json.loads((data / "plush_excerpt_cameras.json").read_text())
    wide = [view | {"fx": 0.4 * view["fx"], "fy": 0.4 * view["fy"]} for view in views]
    (tmp_path / "cameras.json").write_text(json.dumps(wide))
    monkeypatch.setattr(sys, "argv", ["lens_field", str(tmp_path), "--divide", "2", "--k1", str(k1)])
    lens_field.main()
    head, _, _, _, *rows = capsys.readouterr().out.splitlines()
    outside = float(head.partition(" %")[0])
    assert (outside > 0) == (k1 < 0)  # a barrel shows what the pinhole part does not
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[0] for row in cells] == ["pinhole part", "filled", "covering"]
    widths = {row[0]: int(row[1].split(" x ")[0]) for row in cells}
    assert widths["pinhole part"] == views[0]["width"] // 2
    assert widths["filled"] < widths["covering"]
    for row in cells:
        assert all(30 < float(number) < 80 for number in row[3:5])
        # The excerpt has nothing so far outside: there all pictures are black.
        assert row[5] == ("identical" if outside else "-")
