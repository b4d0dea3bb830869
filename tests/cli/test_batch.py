"""Several scenes in one call."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from potr_cl.reference.scenes import random_scene
from potr_cl.workers.opening import Workers, open_workers

KEEP = ["--no-prune", "--no-compact", "--refit", "off"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate("abc"):
        ply.save(f"{name}.ply", random_scene(60 + seed, 1, seed))
    return tmp_path


def test_encode_decode_convert(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["encode", "a.ply", "b.ply", "c.ply", "-o", "small", *KEEP]) == 0
    assert sorted(path.name for path in Path("small").iterdir()) == ["a.potr", "b.potr", "c.potr"]
    assert cli.main(["encode", "b.ply", "-o", "b.potr", *KEEP]) == 0
    assert Path("small/b.potr").read_bytes() == Path("b.potr").read_bytes()
    assert cli.main(["decode", "small/a.potr", "small/b.potr", "-o", "back/"]) == 0
    assert [len(load_scene(f"back/{name}.ply")) for name in "ab"] == [60, 61]
    assert cli.main(["decode", "small/c.potr", "-o", "back", "--to", "spz"]) == 0
    assert cli.main(["convert", "a.ply", "b.ply", "-o", "small", "--to", ".spz"]) == 0
    assert [len(load_scene(f"{where}.spz")) for where in ("back/c", "small/a", "small/b")] == [62, 60, 61]
    assert capsys.readouterr().out.count("small/a.spz: 60 splats") == 1


def test_names_that_no_shell_has_put_in_the_place_of_an_asterisk(folder: Path) -> None:
    assert cli.main(["encode", "*.ply", "-o", "small", *KEEP]) == 0
    assert sorted(path.name for path in Path("small").iterdir()) == ["a.potr", "b.potr", "c.potr"]


def test_one_bad_scene_does_not_lose_the_others(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("b.ply").write_bytes(Path("b.ply").read_bytes()[:-50])
    call = ["encode", "a.ply", "b.ply", "none.ply", "c.ply", "-o", "small", *KEEP, "--json"]
    assert cli.main(call) == 2  # there is no none.ply
    told = capsys.readouterr()
    assert sorted(path.name for path in Path("small").iterdir()) == ["a.potr", "c.potr"]
    lines: list[dict[str, Any]] = [json.loads(line) for line in told.out.splitlines()]
    assert [line["source"]["file"] for line in lines] == ["a.ply", "b.ply", "none.ply", "c.ply"]
    assert ["error" in line for line in lines] == [False, True, True, False]
    assert lines[3]["splats"] == 62
    said = [line for line in told.err.splitlines() if line.startswith("potr-cl: ")]
    assert len(said) == 3
    assert "'b.ply' is truncated" in said[0]
    assert said[2] == "potr-cl: 2 of 4 scenes failed: 'b.ply', 'none.ply'"
    assert "Traceback" not in told.err
    assert cli.main([*call, "--quiet"]) == 2
    assert [line for line in capsys.readouterr().err.splitlines() if line.startswith("potr-cl: ")] == said


def test_a_damaged_one_alone_exits_with_1(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("b.ply").write_bytes(b"no scene")
    assert cli.main(["convert", "a.ply", "b.ply", "-o", "small", "--to", "spz"]) == 1
    assert len(load_scene("small/a.spz")) == 60


def test_a_mistake_of_the_program_does_not_lose_the_others(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = load_scene
    monkeypatch.setattr(
        "potr_cl.cli.scenes.load_scene", lambda path, **more: 1 / 0 if path.name == "a.ply" else read(path, **more)
    )
    assert cli.main(["convert", "a.ply", "b.ply", "-o", "small", "--to", "spz"]) == 1
    assert "'a.ply': unforeseen ZeroDivisionError" in capsys.readouterr().err
    assert len(load_scene("small/b.spz")) == 61


def test_one_device_is_opened_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[Workers] = []

    def opening(device: str | None, cluster: str | None) -> Workers:
        opened.append(open_workers(device, cluster))
        return opened[-1]

    monkeypatch.setattr("potr_cl.cli.encode.open_workers", opening)
    call = ["encode", "a.ply", "b.ply", "c.ply", "-o", "small", "--preset", "fast", "--virtual-views", "8"]
    assert cli.main(call) == 0
    assert len(opened) == 1
    assert capsys.readouterr().out.count("PSNR") == 6


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("encode a.ply sub/a.ply -o small", "'a.ply' and 'sub/a.ply' would both become 'small/a.potr'"),
        ("encode a.ply sub/A.PLY -o small", "would both become"),
        ("encode a.ply b.ply -o c.ply", "need a folder, and 'c.ply' is a file"),
        ("encode a.ply b.ply -o new.potr", "need a folder, and 'new.potr' would be a file"),
        ("encode a.ply b.ply -o -", "standard output takes one scene"),
        ("encode a.ply b.ply -o small --report r.html", "--report is about one scene"),
        ("encode a.ply b.ply -o small -q 7", "quality"),
        ("convert a.ply b.ply c.ply", "give a scene and the name"),
        ("convert a.ply", "give a scene and the name"),
        ("convert a.ply b.ply -o small", "--to is missing"),
        ("convert a.ply b.ply -o . --to ply", "'a.ply' is an input too"),
        ("convert a.ply b.ply -o sub/c/d.spz --to spz", "does not exist"),
    ],
)
def test_refused_before_any_work(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, call: str, said: str
) -> None:
    (folder / "sub").mkdir()
    ply.save("sub/a.ply", random_scene(5))
    monkeypatch.setattr("potr_cl.cli.scenes.load_scene", lambda *_, **__: pytest.fail("a scene was read"))
    assert cli.main(call.split()) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert sorted(path.name for path in folder.rglob("*")) == ["a.ply", "a.ply", "b.ply", "c.ply", "sub"]
