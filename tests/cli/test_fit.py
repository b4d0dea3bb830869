"""The command fit, and --fit of encode."""

from __future__ import annotations

import json
import logging
import re
from contextlib import contextmanager

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from potr_cl.host import process
from tests.cli.calls import cameras_json, run
from tests.reference.scenes import visible_scene


@pytest.fixture
def paths(tmp_path):
    """A scene, half of its splats, and 12 views, 3 of them test views."""
    scene = visible_scene(120, 1, seed=3)
    ply.save(tmp_path / "scene.ply", scene)
    ply.save(tmp_path / "half.ply", scene.subset(np.arange(0, 120, 2)))
    cameras_json(tmp_path / "cameras.json", 12, size=48)
    return tmp_path


def command_of(paths, *more):
    words = ["fit", paths / "half.ply", "--reference", paths / "scene.ply", "--cameras", paths / "cameras.json"]
    return [str(word) for word in [*words, "-o", paths / "out.ply", *more]]


def test_the_command(paths, capsys):
    assert cli.main(command_of(paths, "--steps", "100", "--views-between", "1")) == 0
    captured = capsys.readouterr()
    before, after = (float(value) for value in re.findall(r"([\d.]+) dB", captured.out.splitlines()[-1]))
    assert after > before + 1, "on test views, which the fit has not seen"
    assert "held out" in captured.out
    added = re.search(r"9 training views and (\d+) between them", captured.out)
    assert added is not None
    assert 0 < int(added[1]) <= 9
    assert len(re.findall(r"^fit: \d+ steps, held-out views", captured.err, re.MULTILINE)) == 10
    half, fitted = load_scene(paths / "half.ply"), load_scene(paths / "out.ply")
    assert len(half) == len(fitted)
    assert not np.array_equal(half.means, fitted.means)
    compare = ["compare", paths / "scene.ply", paths / "out.ply", "--cameras", paths / "cameras.json", "--json"]
    judged = json.loads(run(capsys, *compare))
    assert judged["mean"]["b_against_a"]["psnr"] == pytest.approx(after, abs=0.01)


def test_one_training_view_is_too_few(paths, capsys):
    views = json.loads((paths / "cameras.json").read_text())
    (paths / "cameras.json").write_text(json.dumps([v for v in views if v["split"] == "test" or v["id"] == 1]))
    assert cli.main(command_of(paths)) == 2
    assert "two training views" in capsys.readouterr().err
    assert not (paths / "out.ply").exists()


@pytest.mark.slow
def test_encode_with_a_fit(paths, capsys):
    # Of so few splats a fit mends half of the error, far more than the third that it has to.
    words = ["encode", paths / "scene.ply", "--cameras", paths / "cameras.json", "--keep", "0.3"]
    without, with_fit = (
        json.loads(run(capsys, *words, "-o", paths / f"{steps}.potr", "--fit", steps, "--json"))
        for steps in ("off", "400")
    )
    assert without["fit"] is None
    assert with_fit["fit"]["kept"] > 0
    assert "held out" in with_fit["fit"]["said"]
    assert with_fit["splats"] == without["splats"]
    assert with_fit["quality"]["psnr"] > without["quality"]["psnr"] + 0.5
    assert f"fit        {with_fit['fit']['said']}" in run(capsys, *words, "-o", paths / "a.potr", "--fit", "400")
    assert (paths / "a.potr").read_bytes() == (paths / "400.potr").read_bytes()


@pytest.mark.parametrize("command", ["encode", "fit"])
def test_an_interrupted_fit_keeps_its_last_whole_round(paths, command, capsys, monkeypatch):
    """Asked by a first Ctrl-C after its second round; tests/host/test_process.py sends real ones."""
    asked, rounds = process.Asked(), []

    @contextmanager
    def first_interrupt_asks():
        yield asked

    class AfterTwoRounds(logging.Handler):
        def emit(self, record):
            if "held-out views" in record.getMessage():
                rounds.append(record)
            if len(rounds) == 2:
                asked.ask()

    for module in ("stages.fit", "api.editing"):
        monkeypatch.setattr(f"potr_cl.{module}.first_interrupt_asks", first_interrupt_asks)
    handler = AfterTwoRounds()
    logging.getLogger("potr_cl").addHandler(handler)
    words = command_of(paths, "--steps", "100")
    if command == "encode":
        words = ["encode", paths / "scene.ply", *words[4:], "--keep", "0.35"]
        words[words.index("--steps")] = "--fit"
    try:
        said = run(capsys, *words)
    finally:
        logging.getLogger("potr_cl").removeHandler(handler)
    assert "20 of 20 steps are kept, interrupted" in said
    assert len(load_scene(paths / "out.ply")) == (42 if command == "encode" else 60)
