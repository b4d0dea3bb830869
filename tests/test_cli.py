"""The command line: what it prints, what it leaves behind, how it fails."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import ply
from tests.scenes import random_scene, ring_of_cameras


@pytest.fixture
def scene_path(tmp_path):
    path = tmp_path / "scene.ply"
    ply.save(path, random_scene(200, 2))
    return path


@pytest.fixture
def potr_path(tmp_path, scene_path, capsys):
    path = tmp_path / "scene.potr"
    assert cli.main(["encode", str(scene_path), "-o", str(path), "--zstd-level", "1"]) == 0
    capsys.readouterr()
    return path


def cameras_json(path: Path) -> Path:
    views = []
    for k, c in enumerate(ring_of_cameras(8)):
        views.append(
            {
                "id": k,
                "img_name": c.name,
                "width": c.width,
                "height": c.height,
                "position": c.centre.tolist(),
                "rotation": c.rotation.T.tolist(),
                "fx": c.fx,
                "fy": c.fy,
                "split": c.split,
            }
        )
    path.write_text(json.dumps(views))
    return path


def fails(capsys, arguments, code, *words) -> None:
    """One clear line on standard error, the exit code, no traceback."""
    assert cli.main([str(a) for a in arguments]) == code
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("potr-cl: ")]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    for word in words:
        assert word in lines[0]


def test_encode_decode_info(tmp_path, scene_path, capsys):
    potr, back = tmp_path / "a.potr", tmp_path / "back.ply"
    cameras = cameras_json(tmp_path / "cameras.json")
    arguments = ["encode", scene_path, "-o", potr, "-q", "0.7", "--cameras", cameras, "--no-prune", "--no-compact"]
    assert cli.main([str(a) for a in arguments]) == 0
    assert "200 splats" in capsys.readouterr().out
    assert cli.main(["decode", str(potr), "-o", str(back)]) == 0
    assert len(ply.load(back)) == 200
    capsys.readouterr()
    assert cli.main(["info", str(potr), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["splats"], report["sh_degree"], report["q"]) == (200, 2, 0.7)
    assert sum(s["bytes"] for s in report["sections"].values()) == report["bytes"] == potr.stat().st_size
    assert report["source_bytes"] == scene_path.stat().st_size
    assert report["ply_bytes"] == pytest.approx(back.stat().st_size, rel=0.05)
    assert cli.main(["info", str(potr)]) == 0
    text = capsys.readouterr().out
    assert "colour: AC degree 2" in text
    assert "rotation" in text


def test_every_parameter_can_be_set(tmp_path, scene_path, capsys):
    potr = tmp_path / "a.potr"
    options = {
        "--gamma": 0.01,
        "--beta": 0.001,
        "--sf-sh": 20,
        "--sf-opacity": 30,
        "--sf-rotation": 40,
        "--sf-scale": 50,
    }
    flat = [str(x) for pair in options.items() for x in pair]
    cameras = cameras_json(tmp_path / "cameras.json")
    assert cli.main(["encode", str(scene_path), "-o", str(potr), "--cameras", str(cameras), *flat]) == 0
    capsys.readouterr()
    assert cli.main(["info", str(potr), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scale_factors"] == {"scale": 50, "rotation": 40, "opacity": 30, "sh": 20}
    assert (report["gamma"], report["beta"]) == (0.01, 0.001)


def test_both_entropy_stages(tmp_path, scene_path, capsys):
    scenes = []
    for entropy in ("zstd", "npz"):
        potr = tmp_path / f"{entropy}.potr"
        assert cli.main(["encode", str(scene_path), "-o", str(potr), "--entropy", entropy]) == 0
        assert cli.main(["decode", str(potr), "-o", str(tmp_path / "back.ply")]) == 0
        scenes.append(ply.load(tmp_path / "back.ply"))
    assert np.array_equal(scenes[0].sh, scenes[1].sh)
    capsys.readouterr()


def test_no_such_input(tmp_path, capsys):
    for command in ("encode", "decode"):
        fails(capsys, [command, tmp_path / "none.potr", "-o", tmp_path / "out"], 2, "none.potr")
    fails(capsys, ["info", tmp_path / "none.potr"], 2, "none.potr")
    assert list(tmp_path.iterdir()) == []


def test_directories(tmp_path, scene_path, potr_path, capsys):
    fails(capsys, ["decode", tmp_path, "-o", tmp_path / "out.ply"], 2, str(tmp_path))
    fails(capsys, ["info", tmp_path], 2, str(tmp_path))
    fails(capsys, ["encode", scene_path, "-o", tmp_path], 2, str(tmp_path))
    fails(capsys, ["decode", potr_path, "-o", tmp_path], 2, str(tmp_path))
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "nowhere" / "a.potr"], 2, "nowhere")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"ply\nformat ascii 1.0\n", "not a .potr"),
        (b"POTR\r\n\x1a\n", "truncated"),
        (bytes(500), "not a"),
    ],
)
def test_other_files(tmp_path, capsys, content, word):
    path = tmp_path / "a.potr"
    path.write_bytes(content)
    fails(capsys, ["decode", path, "-o", tmp_path / "out.ply"], 1, str(path), word)
    fails(capsys, ["info", path], 1, str(path), word)
    assert not (tmp_path / "out.ply").exists()


def test_damaged_file_keeps_the_old_output(tmp_path, potr_path, capsys):
    out = tmp_path / "out.ply"
    out.write_bytes(b"precious")
    data = potr_path.read_bytes()
    for damaged in (data[: len(data) // 2], data[:-3] + b"abc", data[:200] + b"\xff" + data[201:]):
        path = tmp_path / "damaged.potr"
        path.write_bytes(damaged)
        fails(capsys, ["decode", path, "-o", out], 1, "damaged.potr")
        assert out.read_bytes() == b"precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["damaged.potr", "out.ply", "scene.ply", "scene.potr"]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["-q", "1.5"], "quality"),
        (["-q", "nan"], "quality"),
        (["--sf-sh", "0"], "sf_sh"),
        (["--gamma", "-1"], "gamma"),
        (["--zstd-level", "40"], "level 40"),
        (["--threads", "-2"], "--threads"),
    ],
)
def test_wrong_options(tmp_path, scene_path, capsys, options, word):
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", *options], 2, word)
    assert not (tmp_path / "a.potr").exists()


def test_wrong_arguments_exit_with_2(capsys):
    for arguments in (["encode"], ["fly"], [], ["encode", "a.ply", "-o", "b", "-q", "good"]):
        with pytest.raises(SystemExit) as caught:
            cli.main(arguments)
        assert caught.value.code == 2
    capsys.readouterr()


def test_bad_cameras(tmp_path, scene_path, capsys):
    path = tmp_path / "cameras.json"
    path.write_text('{"neither": "nor"}')
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", path], 1, "cameras.json")
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", tmp_path / "no"], 2, "no")
    assert not (tmp_path / "a.potr").exists()


def test_a_scene_too_large_to_quantise(tmp_path, capsys):
    scene = random_scene(5, 0)
    scene.sh[2] = 1e30
    ply.save(tmp_path / "scene.ply", scene)
    fails(capsys, ["encode", tmp_path / "scene.ply", "-o", tmp_path / "a.potr"], 1, "too large to quantise")
    assert not (tmp_path / "a.potr").exists()


@pytest.mark.skipif(os.name != "posix", reason="needs resource limits")
def test_disk_full(tmp_path, scene_path, potr_path):
    """A file size limit stands for a full disk: the write fails in the middle."""
    script = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000));"
        "from potr_cl.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    for arguments in (["encode", scene_path, "-o", tmp_path / "x"], ["decode", potr_path, "-o", tmp_path / "x"]):
        result = subprocess.run(
            [sys.executable, "-c", script, *map(str, arguments)], capture_output=True, text=True, check=False
        )
        assert result.returncode == 1
        assert "cannot write" in result.stderr
        assert "Traceback" not in result.stderr
        assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply", "scene.potr"]


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX permissions")
def test_no_permission(scene_path):
    with tempfile.TemporaryDirectory() as folder:  # not tmp_path, which nobody else may even enter
        locked, scene = Path(folder) / "locked", Path(folder) / "scene.ply"
        shutil.copy(scene_path, scene)
        locked.mkdir()
        secret = Path(folder) / "secret.ply"
        shutil.copy(scene_path, secret)
        for path, mode in ((Path(folder), 0o755), (locked, 0o555), (scene, 0o644), (secret, 0o000)):
            path.chmod(mode)
        # Root may do anything: give the right up, once everything is imported.
        script = (
            "import os, sys; from potr_cl.cli import main;os.geteuid() or os.setuid(65534);sys.exit(main(sys.argv[1:]))"
        )
        for source, target in ((scene, locked / "a.potr"), (secret, Path(folder) / "a.potr")):
            command = [sys.executable, "-c", script, "encode", str(source), "-o", str(target)]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            assert result.returncode == 2, result.stderr
            assert "Permission denied" in result.stderr
            assert "Traceback" not in result.stderr
            assert not target.exists()


def test_interrupt(tmp_path, scene_path, capsys, monkeypatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "encode", interrupted)
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr"], 130, "interrupted")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply"]


def test_module_runs():
    command = [sys.executable, "-m", "potr_cl", "--version"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.startswith("potr-cl ")
