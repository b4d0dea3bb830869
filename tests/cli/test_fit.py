"""The command fit, and --fit of encode."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.cameras import cameras_json
from potr_cl.formats.scenes import ply
from tests.reference.scenes import ring_of_cameras, visible_scene


@pytest.fixture
def paths(tmp_path):
    """A scene, half of its splats, and 12 views, 3 of them test views."""
    scene = visible_scene(120, 1, seed=3)
    ply.save(tmp_path / "scene.ply", scene)
    ply.save(tmp_path / "half.ply", scene.subset(np.arange(0, 120, 2)))
    views = [dataclasses.replace(c, name=f"view_{k}") for k, c in enumerate(ring_of_cameras(12, size=48))]
    (tmp_path / "cameras.json").write_text(
        json.dumps(
            [
                {
                    "id": k, "img_name": c.name, "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy,
                    "position": c.centre.tolist(), "rotation": c.rotation.T.tolist(), "split": c.split,
                }
                for k, c in enumerate(views)
            ]
        )
    )  # fmt: skip
    assert len(cameras_json.load(tmp_path / "cameras.json")) == 12
    return tmp_path


def command_of(paths, *more):
    words = ["fit", paths / "half.ply", "--reference", paths / "scene.ply", "--cameras", paths / "cameras.json"]
    return [str(word) for word in [*words, "-o", paths / "out.ply", *more]]


def decibels(text):
    return [float(value) for value in re.findall(r"([\d.]+) dB", text)]


def test_the_command(paths, capsys):
    assert cli.main(command_of(paths, "--steps", "100")) == 0
    captured = capsys.readouterr()
    before, after = decibels(captured.out.splitlines()[-1])
    assert after > before + 1, "on test views, which the fit has not seen"
    assert "held out" in captured.out
    assert len(re.findall(r"^fit: \d+ steps, held-out views", captured.err, re.MULTILINE)) == 10
    half, fitted = load_scene(paths / "half.ply"), load_scene(paths / "out.ply")
    assert len(half) == len(fitted)
    assert not np.array_equal(half.means, fitted.means)
    compare = ["compare", paths / "scene.ply", paths / "out.ply", "--cameras", paths / "cameras.json", "--json"]
    assert cli.main([str(word) for word in compare]) == 0
    judged = json.loads(capsys.readouterr().out)
    assert judged["mean"]["b_against_a"]["psnr"] == pytest.approx(after, abs=0.01)


def test_views_between_are_looked_at_too(paths, capsys):
    assert cli.main(command_of(paths, "--steps", "20", "--views-between", "1")) == 0
    added = re.search(r"9 training views and (\d+) between them", capsys.readouterr().out)
    assert added is not None
    assert 0 < int(added[1]) <= 9


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--steps", "-1"), "-1 steps"),
        (("--steps", "10000000"), "steps of the fit"),
        (("--views-between", "101"), "from 0 to 100"),
    ],
    ids=str,
)
def test_what_is_out_of_range_is_told_before_anything_is_read(paths, capsys, more, said):
    (paths / "half.ply").write_bytes(b"")
    assert cli.main(command_of(paths, *more)) == 2
    assert said in capsys.readouterr().err
    assert not (paths / "out.ply").exists()


def test_one_training_view_is_too_few(paths, capsys):
    views = json.loads((paths / "cameras.json").read_text())
    (paths / "cameras.json").write_text(json.dumps([v for v in views if v["split"] == "test" or v["id"] == 1]))
    assert cli.main(command_of(paths)) == 2
    assert "two training views" in capsys.readouterr().err
    assert not (paths / "out.ply").exists()


@pytest.mark.slow
def test_encode_with_a_fit(paths, capsys):
    # Of so few splats a fit mends half of the error, far more than the third that it has to.
    words = ["encode", paths / "scene.ply", "--cameras", paths / "cameras.json", "--keep", "0.3", "--json"]
    reports = []
    for steps in ("off", "400"):
        out = paths / f"{steps}.potr"
        assert cli.main([str(word) for word in [*words, "-o", out, "--fit", steps]]) == 0
        reports.append(json.loads(capsys.readouterr().out))
    without, with_fit = reports
    assert without["fit"] is None
    assert with_fit["fit"]["kept"] > 0
    assert "held out" in with_fit["fit"]["said"]
    assert with_fit["splats"] == without["splats"]
    assert with_fit["quality"]["psnr"] > without["quality"]["psnr"] + 0.5
    assert cli.main([str(word) for word in [*words[:-1], "-o", paths / "a.potr", "--fit", "400"]]) == 0
    assert f"fit        {with_fit['fit']['said']}" in capsys.readouterr().out
    assert (paths / "a.potr").read_bytes() == (paths / "400.potr").read_bytes()


def interrupted(words, times):
    """Run a command that would fit for hours, with so many interrupts after the second round of the fit."""
    root = Path(potr_cl.__file__).parents[1]
    command = [sys.executable, "-m", "potr_cl", *map(str, words)]
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        rounds = 0
        for line in process.stderr:
            rounds += "held-out views" in line
            if rounds == 2 and "held-out views" in line:
                process.send_signal(signal.SIGINT)
            if "interrupted: finishing with" in line and times == 2:
                process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=300)
    return process.returncode, output, rounds


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize("command", ["encode", pytest.param("fit", marks=pytest.mark.slow)])
def test_an_interrupted_fit_keeps_its_last_whole_round(paths, command):
    if command == "encode":
        words = ["encode", paths / "scene.ply", "--cameras", paths / "cameras.json", "--keep", "0.5"]
        words += ["-o", paths / "out.ply", "--fit", "6000"]
    else:
        words = command_of(paths, "--steps", "6000")
    code, output, rounds = interrupted(words, 1)
    assert code == 0
    said = re.search(r"(\d+) of (\d+) steps are kept, interrupted", output)
    assert said is not None, output
    kept, done = int(said[1]), int(said[2])
    assert kept % 600 == 0
    assert 0 < kept <= 600 * rounds <= done < 6000
    assert len(load_scene(paths / "out.ply")) == 60


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_a_second_interrupt_ends_the_command(paths):
    code, _, _ = interrupted(command_of(paths, "--steps", "6000"), 2)
    assert code == 130
    # Where the second one comes late, the scene that the first one asked for is written by then, whole.
    assert not (paths / "out.ply").exists() or len(load_scene(paths / "out.ply")) == 60
