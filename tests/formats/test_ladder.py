"""Ladders: one scene at several qualities, and what describes them."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from potr_cl import DataError, UsageError
from potr_cl.formats.ladder import DESCRIPTION, Ladder, Rung, ladder_at, qualities, read_ladder

RUNGS = (Rung(0.1, "a_q0.1.potr", 1000, 20, 31.5, 0.9), Rung(0.9, "a_q0.9.potr", 5000, 90, None, 1.0))


def written(folder: Any, **changes: Any) -> Any:
    ladder = Ladder(folder / DESCRIPTION, "a.ply", 9000, "3 test views", RUNGS)
    ladder.path.write_text(json.dumps(ladder.document() | changes))
    return ladder.path


def test_what_is_written_is_read(tmp_path):
    ladder = Ladder(tmp_path / DESCRIPTION, "a.ply", 9000, "3 test views", RUNGS)
    ladder.save()
    assert read_ladder(ladder.path) == ladder
    assert ladder.file(RUNGS[0]) == tmp_path / "a_q0.1.potr"
    dataclasses.replace(ladder, scene="\udcff.ply").save()
    assert read_ladder(ladder.path).scene == "\\udcff.ply"
    Ladder(tmp_path / DESCRIPTION, "", None, "", RUNGS[:1]).save()
    assert read_ladder(ladder.path).scene_bytes is None
    written(tmp_path, rungs=[vars(rung) for rung in reversed(RUNGS)])
    assert [rung.q for rung in read_ladder(ladder.path).rungs] == [0.1, 0.9]
    hostile = read_ladder(written(tmp_path, scene="\x1b[2J" * 500, judged_by="\u202e"))
    assert hostile.scene.isprintable()
    assert hostile.judged_by.isprintable()


def test_where_a_ladder_is(tmp_path):
    path = written(tmp_path)
    other = tmp_path / "other.json"
    other.write_bytes(path.read_bytes())
    (tmp_path / "cameras.json").write_text("[]")
    assert ladder_at(tmp_path) == ladder_at(path) == path
    assert ladder_at(other) == other
    assert ladder_at(tmp_path / "cameras.json") is None
    assert ladder_at(tmp_path / "scene.ply") is None


RUNG = vars(RUNGS[0])
WRONG = {
    "kind": ("other",),
    "version": (2, None),
    "rungs": ([], {}, [RUNG] * 1001, [7]),
    "scene_bytes": (-1, 1.5, "9"),
}
WRONG_OF_A_RUNG = {
    "file": ("../a.potr", "/etc/passwd", "C:\\a.potr", "a\nb.potr", 3, ""),
    "q": (1.5, "0.5", float("nan")),
    "bytes": (-1, 1 << 70),
    "splats": (0.5,),
    "psnr": ("high", float("inf")),
    "ssim": ([1],),
}


@pytest.mark.parametrize(("field", "value"), [(field, value) for field, values in WRONG.items() for value in values])
def test_damaged_descriptions_are_refused_by_name(tmp_path, field, value):
    with pytest.raises(DataError, match=DESCRIPTION):
        read_ladder(written(tmp_path, **{field: value}))


@pytest.mark.parametrize(
    ("field", "value"), [(field, value) for field, values in WRONG_OF_A_RUNG.items() for value in values]
)
def test_damaged_rungs_are_refused_by_name(tmp_path, field, value):
    with pytest.raises(DataError, match=DESCRIPTION):
        read_ladder(written(tmp_path, rungs=[RUNG | {field: value}]))


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff" * 9, b"[" * 50_000, b" " * (2 << 20)])
def test_what_is_no_description(tmp_path, content):
    path = tmp_path / DESCRIPTION
    path.write_bytes(content)
    with pytest.raises(DataError, match=DESCRIPTION):
        read_ladder(path)
    with pytest.raises(UsageError):
        read_ladder(tmp_path / "none.json")


@pytest.mark.parametrize("given", ["0.5,0.1, 1", [0.5, 0.1, 1]])
def test_qualities_are_told_in_any_order(given):
    assert qualities(given) == (0.1, 0.5, 1.0)


@pytest.mark.parametrize("given", ["", "a", "0.1,", "0.5,0.5", "2", "-0.1", "nan", [], ["x"], [None], 3])
def test_wrong_qualities_are_told(given):
    with pytest.raises(UsageError, match="--ladder"):
        qualities(given)
