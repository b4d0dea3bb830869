"""Several scenes in one call."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from potr_cl.workers.host import open_workers
from tests.cli.calls import KEEP, cameras_json, refused
from tests.reference.scenes import random_scene


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate("abc"):
        ply.save(f"{name}.ply", random_scene(60 + seed, 1, seed))
    return tmp_path


def test_encode_decode_convert(folder, capsys):
    assert cli.main(["encode", "a.ply", "b.ply", "c.ply", "-o", "small", *KEEP]) == 0
    assert names("small") == ["a.potr", "b.potr", "c.potr"]
    assert cli.main(["encode", "b.ply", "-o", "b.potr", *KEEP]) == 0
    assert Path("small/b.potr").read_bytes() == Path("b.potr").read_bytes()
    assert cli.main(["decode", "small/a.potr", "small/b.potr", "-o", "back/"]) == 0
    assert [len(load_scene(f"back/{name}.ply")) for name in "ab"] == [60, 61]
    assert cli.main(["decode", "small/c.potr", "-o", "back", "--to", "spz"]) == 0
    assert cli.main(["convert", "a.ply", "b.ply", "-o", "small", "--to", ".spz"]) == 0
    assert [len(load_scene(f"{where}.spz")) for where in ("back/c", "small/a", "small/b")] == [62, 60, 61]
    assert capsys.readouterr().out.count("small/a.spz: 60 splats") == 1


def test_one_bad_scene_does_not_lose_the_others(folder, capsys):
    Path("b.ply").write_bytes(Path("b.ply").read_bytes()[:-50])
    call = ["encode", "a.ply", "b.ply", "none.ply", "c.ply", "-o", "small", *KEEP, "--json"]
    assert cli.main(call) == 2  # there is no none.ply
    told = capsys.readouterr()
    assert names("small") == ["a.potr", "c.potr"]
    lines = [json.loads(line) for line in told.out.splitlines()]
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


def test_neither_damage_nor_a_mistake_of_the_program_loses_the_others(folder, capsys, monkeypatch):
    Path("b.ply").write_bytes(b"no scene")
    assert cli.main(["convert", "a.ply", "b.ply", "-o", "small", "--to", "spz"]) == 1
    assert names("small") == ["a.spz"]
    read = load_scene
    monkeypatch.setattr(
        "potr_cl.formats.load_scene", lambda path, **more: 1 / 0 if path.name == "a.ply" else read(path, **more)
    )
    assert cli.main(["convert", "a.ply", "c.ply", "-o", "again", "--to", "spz"]) == 1
    assert "'a.ply': unforeseen ZeroDivisionError" in capsys.readouterr().err
    assert names("again") == ["c.spz"]


def test_one_device_is_opened_once(folder, monkeypatch, capsys):
    opened = []

    def opening(device, cluster):
        opened.append(open_workers(device, cluster))
        return opened[-1]

    monkeypatch.setattr("potr_cl.api.encoder.open_workers", opening)
    views = ["--cameras", str(cameras_json(folder / "cameras.json")), "--cameras-anyway"]
    assert cli.main(["encode", "a.ply", "b.ply", "-o", "small", "--preset", "fast", "--iterations", "2", *views]) == 0
    assert len(opened) == 1
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows] == ["a.potr", "b.potr"]
    assert all(" kB  " in row and "PSNR" in row for row in rows)


@pytest.fixture
def trainings(folder):
    """As the original implementation leaves them: cameras beside two of three scenes."""
    for seed, name in enumerate(("bicycle", "garden", "room")):
        place = folder / name / "point_cloud" / "iteration_30000"
        place.mkdir(parents=True)
        ply.save(place / "point_cloud.ply", random_scene(80 + seed, 0, seed))
        if name != "garden":
            view = {"id": 0, "width": 64, "height": 48, "fx": 50, "fy": 50, "rotation": np.eye(3).tolist()}
            views = [view | {"img_name": f"{name}_{k}.png", "position": [0, 0, -5 - k]} for k in range(3)]
            (folder / name / "cameras.json").write_text(json.dumps(views))
    return ["encode", "*/point_cloud/iteration_30000/point_cloud.ply", "-o", "small", *KEEP]


def test_scenes_of_one_name_are_told_apart_by_their_folders(trainings, folder):
    assert cli.main(trainings) == 0
    assert names("small") == ["bicycle.potr", "garden.potr", "room.potr"]
    (folder / "room" / "point_cloud.ply").write_bytes((folder / "a.ply").read_bytes())
    assert cli.main(["encode", "a.ply", "**/point_cloud.ply", "-o", "deep", *KEEP]) == 0
    assert names("deep") == [
        "a.potr",
        "bicycle_point_cloud_iteration_30000_point_cloud.potr",
        "garden_point_cloud_iteration_30000_point_cloud.potr",
        "room_point_cloud.potr",
        "room_point_cloud_iteration_30000_point_cloud.potr",
    ]


def test_cameras_beside_each_scene(trainings, capsys):
    assert cli.main([*trainings, "--cameras", "beside", "--cameras-anyway", "--json"]) == 0
    told = capsys.readouterr()
    quality = {Path(line["file"]).stem: line["quality"] for line in map(json.loads, told.out.splitlines())}
    assert quality["garden"] == "not judged: there are no cameras to look from"
    for name in ("bicycle", "room"):
        assert {view["name"] for view in quality[name]["views"]} <= {f"{name}_{k}" for k in range(3)}
    assert "3 views of" in told.err


def test_a_batch_goes_on_where_it_was_stopped(trainings, capsys):
    scene = Path("garden/point_cloud/iteration_30000/point_cloud.ply")
    whole = scene.read_bytes()
    scene.write_bytes(whole[:-50])
    assert cli.main([*trainings, "--skip-existing"]) == 1
    told = capsys.readouterr()
    assert [line.split()[0] for line in told.err.splitlines() if " of 3: " in line] == ["1", "2", "3"]
    assert "s left for all" in told.err
    bicycle, garden, room = told.out.splitlines()
    assert [row.split()[0] for row in (bicycle, room)] == ["bicycle.potr", "room.potr"]
    assert garden.startswith("garden.potr   failed: ")
    assert "is truncated" in garden
    before = Path("small/room.potr").stat().st_mtime_ns
    scene.write_bytes(whole)
    assert cli.main([*trainings, "--skip-existing"]) == 0
    assert "skipping 2 of 3 scenes: their output exists" in capsys.readouterr().err
    assert Path("small/garden.potr").exists()
    assert Path("small/room.potr").stat().st_mtime_ns == before
    assert cli.main([*trainings, "--skip-existing"]) == 0


def test_an_interrupted_batch_says_how_to_go_on(trainings, capsys, monkeypatch):
    read = load_scene

    def interrupted(path, **more):
        if "room" in str(path):
            raise KeyboardInterrupt
        return read(path, **more)

    monkeypatch.setattr("potr_cl.formats.load_scene", interrupted)
    assert cli.main(trainings) == 130
    assert "2 of 3 scenes are done: --skip-existing goes on behind them" in capsys.readouterr().err
    assert names("small") == ["bicycle.potr", "garden.potr"]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("encode a.ply ./a.ply -o small", "'a.ply' and 'a.ply' would both become 'small/a.potr'"),
        ("encode a.ply A.PLY -o small", "would both become"),
        ("encode a.ply b.ply -o c.ply", "need a folder, and 'c.ply' is a file"),
        ("encode a.ply b.ply -o new.potr", "need a folder, and 'new.potr' would be a file"),
        ("encode a.ply b.ply -o -", "standard output takes one scene"),
        ("encode a.ply b.ply -o small --report r.html", "--report is about one scene"),
        ("encode a.ply b.ply -o small -q 7", "quality"),
        ("convert a.ply b.ply c.ply", "usage: convert IN OUT"),
        ("convert a.ply", "usage: convert IN OUT"),
        ("convert a.ply b.ply -o small", "--to is missing"),
        ("convert a.ply b.ply -o . --to ply", "'a.ply' is an input too"),
        ("convert a.ply b.ply -o sub/c/d.spz --to spz", "does not exist"),
    ],
)
def test_refused_before_any_work(folder, capsys, monkeypatch, call, said):
    (folder / "sub").mkdir()
    ply.save("sub/a.ply", random_scene(5))
    monkeypatch.setattr("potr_cl.formats.load_scene", lambda *_, **__: pytest.fail("a scene was read"))
    refused(capsys, call, said)
