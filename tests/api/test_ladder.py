"""Encoding to a ladder: the files of plain encodes, and what they lost."""

from __future__ import annotations

import json
import os
import shlex

import numpy as np
import pytest

import potr_cl
from potr_cl.cli import main
from potr_cl.formats.ladder import read_ladder

pytestmark = pytest.mark.one_runtime
KEEP = {"prune": False, "refit": False, "compact": False}


def test_a_ladder_has_the_files_of_plain_encodes(files, tmp_path, caplog):
    caplog.set_level("INFO", "potr_cl")
    few = {"preset": "fast", "iterations": 2}
    ladder = potr_cl.encode_ladder(files["scene"], tmp_path / "new" / "ladder", "0.8,0.2", files["cameras"], **few)
    assert [message for message in caplog.messages if "_q0." in message] == [
        f"{ladder.file(rung)}: q {rung.q:g}, {rung.bytes:,} bytes, {rung.splats:,} splats, {rung.psnr:.2f} dB"
        for rung in ladder.rungs
    ]
    assert ladder == read_ladder(ladder.path)
    assert ladder.scene == "scene.ply"
    assert ladder.scene_bytes == files["scene"].stat().st_size
    for q, rung in zip((0.2, 0.8), ladder.rungs, strict=True):
        plain = potr_cl.encode(files["scene"], files["cameras"], q=q, **few)
        data = ladder.file(rung).read_bytes()
        assert (rung.q, rung.file, rung.bytes, rung.splats) == (q, f"scene_q{q}.potr", len(data), len(plain.order))
        assert data == plain.data
        compared = potr_cl.compare(files["scene"], ladder.file(rung), files["cameras"])
        assert rung.psnr == pytest.approx(compared.psnr, abs=1e-3)
        assert rung.ssim == pytest.approx(compared.ssim, abs=1e-5)


def test_the_command_does_the_same_and_says_what_shows_it(files, tmp_path, capsys):
    scene, cameras, folder = (str(each) for each in (files["scene"], files["cameras"], tmp_path / "a ladder"))
    ladder = potr_cl.encode_ladder(scene, tmp_path / "python", [0.2, 0.8], cameras, **KEEP)
    plain = ["--no-prune", "--no-compact", "--refit", "off"]
    typed = ["encode", scene, "-o", folder, "--cameras", cameras, "--ladder", "0.2,0.8", *plain]
    assert main([*typed, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == ladder.document()
    for path in ladder.path.parent.iterdir():
        assert (tmp_path / "a ladder" / path.name).read_bytes() == path.read_bytes()
    assert main([*typed, "--no-quality"]) == 0
    command = capsys.readouterr().out.splitlines()[-1]
    assert shlex.split(command)[-6:] == ["potr-cl", "view", scene, folder, "--cameras", cameras]


def test_without_views_nothing_is_judged(files, tmp_path):
    scene = potr_cl.read_scene(files["scene"])
    ladder = potr_cl.encode_ladder(scene, tmp_path, [0.5], **KEEP)
    assert (ladder.rungs[0].psnr, ladder.rungs[0].ssim, ladder.judged_by) == (None, None, "")
    assert np.isfinite(potr_cl.decode(ladder.file(ladder.rungs[0])).means).all()


@pytest.mark.skipif(os.name != "posix", reason="names are text there")
def test_a_scene_whose_name_is_not_utf8(files, tmp_path):
    scene = tmp_path / "odd\udcff.ply"
    scene.write_bytes(files["scene"].read_bytes())
    ladder = potr_cl.encode_ladder(scene, tmp_path / "ladder", [0.5], **KEEP)
    assert read_ladder(ladder.path).file(ladder.rungs[0]).name == "odd__q0.5.potr"
    assert ladder.file(ladder.rungs[0]).exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--ladder", "0.1,x"], "--ladder is '0.1,x'"),
        (["--ladder", "0.5", "--report", "page.html"], "--report is about one file"),
        (["--ladder", "0.5", "-o", "a.potr"], "a folder"),
        (["--ladder", "0.5", "-o", "-"], "a folder"),
    ],
)
def test_what_a_ladder_cannot_do_is_told(files, tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    given = [] if "-o" in words else ["-o", "folder"]
    assert main(["encode", str(files["scene"]), *words, *given]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_no_input_is_replaced(files, tmp_path, capsys):
    """A scene that has the name of a rung."""
    scene = tmp_path / "a_q0.5.potr"
    scene.write_bytes(files["potr"].read_bytes())
    link = tmp_path / "a.potr"
    link.symlink_to(scene)
    assert main(["encode", str(link), "-o", f"{tmp_path}/", "--ladder", "0.5", "--no-prune", "--refit", "off"]) == 2
    assert "is an input too" in capsys.readouterr().err
    assert scene.read_bytes() == files["potr"].read_bytes()
