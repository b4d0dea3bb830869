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
    content = ladder.document() | changes
    ladder.path.write_text(json.dumps(content))
    return ladder.path


def test_what_is_written_is_read(tmp_path):
    ladder = Ladder(tmp_path / DESCRIPTION, "a.ply", 9000, "3 test views", RUNGS)
    ladder.save()
    assert read_ladder(ladder.path) == ladder
    assert ladder.file(RUNGS[0]) == tmp_path / "a_q0.1.potr"
    odd = dataclasses.replace(ladder, scene="\udcff.ply")
    odd.save()
    assert read_ladder(odd.path).scene == "\\udcff.ply"
    Ladder(tmp_path / DESCRIPTION, "", None, "", RUNGS[:1]).save()
    assert read_ladder(ladder.path).scene_bytes is None


def test_rungs_stand_by_rising_quality(tmp_path):
    path = written(tmp_path, rungs=[vars(rung) for rung in reversed(RUNGS)])
    assert [rung.q for rung in read_ladder(path).rungs] == [0.1, 0.9]


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


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "other"},
        {"version": 2},
        {"version": None},
        {"rungs": []},
        {"rungs": {}},
        {"rungs": [RUNG] * 1001},
        {"rungs": [7]},
        {"scene_bytes": -1},
        {"scene_bytes": 1.5},
        {"scene_bytes": "9"},
        *(
            {"rungs": [RUNG | change]}
            for change in (
                {"file": "../a.potr"},
                {"file": "/etc/passwd"},
                {"file": "C:\\a.potr"},
                {"file": "a\nb.potr"},
                {"file": 3},
                {"file": ""},
                {"q": 1.5},
                {"q": "0.5"},
                {"q": float("nan")},
                {"bytes": -1},
                {"bytes": 1 << 70},
                {"splats": 0.5},
                {"psnr": "high"},
                {"psnr": float("inf")},
                {"ssim": [1]},
            )
        ),
    ],
)
def test_damaged_descriptions_are_refused_by_name(tmp_path, changes):
    path = written(tmp_path, **changes)
    with pytest.raises(DataError, match=DESCRIPTION):
        read_ladder(path)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff" * 9, b"[" * 50_000, b" " * (2 << 20)])
def test_what_is_no_description(tmp_path, content):
    path = tmp_path / DESCRIPTION
    path.write_bytes(content)
    with pytest.raises(DataError, match=DESCRIPTION):
        read_ladder(path)
    with pytest.raises(UsageError):
        read_ladder(tmp_path / "none.json")


def test_hostile_texts_are_plain(tmp_path):
    ladder = read_ladder(written(tmp_path, scene="\x1b[2J" * 500, judged_by="\u202e"))
    assert ladder.scene.isprintable()
    assert ladder.judged_by.isprintable()


@pytest.mark.parametrize("given", ["0.5,0.1, 1", [0.5, 0.1, 1]])
def test_qualities_are_told_in_any_order(given):
    assert qualities(given) == (0.1, 0.5, 1.0)


@pytest.mark.parametrize("given", ["", "a", "0.1,", "0.5,0.5", "2", "-0.1", "nan", [], ["x"], [None], 3])
def test_wrong_qualities_are_told(given):
    with pytest.raises(UsageError, match="--ladder"):
        qualities(given)
