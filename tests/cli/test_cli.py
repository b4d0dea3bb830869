"""What all commands share: input that is missing or wrong, output that cannot be written, help, interruptions."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from potr_cl import cli
from tests.cli.calls import KEEP, fails


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def printed(*words: object) -> str:
    """What a Python program prints that is given by its lines and its arguments."""
    return subprocess.run([sys.executable, "-c", *map(str, words)], check=True, capture_output=True, text=True).stdout


def test_what_looks_at_no_views_opens_no_device(tmp_path, scene_path, monkeypatch):
    opened = []
    monkeypatch.setattr("potr_cl.workers.host.Device", opened.append)
    assert cli.main(["encode", str(scene_path), "-o", str(tmp_path / "scene.potr"), *KEEP]) == 0
    assert not opened


def test_other_and_damaged_files_keep_the_old_output(tmp_path, potr_path, capsys):
    path, out, whole = tmp_path / "a.potr", tmp_path / "out.ply", potr_path.read_bytes()
    out.write_bytes(b"precious")
    for content, word in (
        (b"", "empty"),
        (b"ply\nformat ascii 1.0\n", "not a .potr"),
        (b"POTR\r\n\x1a\n", "truncated"),
        (bytes(500), "not a"),
        (whole[: len(whole) // 2], ""),
        (whole[:-3] + b"abc", ""),
        (whole[:200] + b"\xff" + whole[201:], ""),
    ):
        path.write_bytes(content)
        fails(capsys, ["decode", path, "-o", out], 1, str(path), word)
        if word:
            fails(capsys, ["info", path], 1, str(path), word)
        assert out.read_bytes() == b"precious"
    assert names(tmp_path) == ["a.potr", "out.ply", "scene.ply", "scene.potr"]


def test_bad_cameras(tmp_path, scene_path, capsys):
    path = tmp_path / "cameras.json"
    path.write_text('{"neither": "nor"}')
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", path], 1, "cameras.json")
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", tmp_path / "no.json"], 2, "no.json")
    assert names(tmp_path) == ["cameras.json", "scene.ply"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX permissions")
def test_no_permission(scene_path):
    # Root may do anything: give the right up, once everything is imported.
    script = """
import contextlib, io, json, locale, os, sys
from potr_cl.cli import edit, encode, main
os.geteuid() or os.setuid(65534)
told = []
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        told.append([main(words), said.getvalue()])
print(json.dumps(told))
"""
    with tempfile.TemporaryDirectory() as name:  # not tmp_path, which nobody else may even enter
        folder = Path(name)
        locked, scene, secret = folder / "locked", folder / "scene.ply", folder / "secret.ply"
        locked.mkdir()
        for copy in (scene, secret):
            shutil.copy(scene_path, copy)
        for path, mode in ((folder, 0o755), (locked, 0o555), (scene, 0o644), (secret, 0o000)):
            path.chmod(mode)
        # What takes long looks first.
        few = ["--virtual-views", "4"]
        calls = [
            ["encode", secret, "-o", folder / "a.potr", *KEEP],
            ["encode", scene, "-o", locked / "a.potr", *KEEP],
            ["prune", scene, "-o", locked / "a.ply", "--iterations", "1", *few],
            ["compact", scene, "-o", locked / "a.ply", *few],
            ["encode", scene, "-o", f"{locked}/", "--ladder", "0.2", *KEEP],
        ]
        told = json.loads(printed(script, json.dumps([[str(word) for word in call] for call in calls])))
        assert names(folder) == ["locked", "scene.ply", "secret.ply"]
        assert names(locked) == []
    for number, (code, said) in enumerate(told):
        assert code == 2, said
        assert said.startswith("potr-cl: cannot write" if number else "potr-cl: ")
        assert said.endswith("Permission denied\n")
        assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "work"),
    [("encode", "api.encoder.run_stages"), ("prune", "stages.prune.prune_scene")],
)
def test_interrupt(tmp_path, scene_path, cameras_path, capsys, monkeypatch, command, work):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"potr_cl.{work}", interrupted)
    out = tmp_path / ("out.potr" if command == "encode" else "out.ply")
    fails(capsys, [command, scene_path, "--cameras", cameras_path, "-o", out], 130, "interrupted")
    assert names(tmp_path) == ["cameras.json", "scene.ply"]


def test_decoding_imports_what_decoding_needs(potr_path, tmp_path):
    """To decode takes less time than to open an OpenCL loader."""
    program = "import sys; from potr_cl import cli; code = cli.main(sys.argv[1:]); print(*sys.modules); sys.exit(code)"
    modules = printed(program, "decode", potr_path, "-o", tmp_path / "out.ply").split()
    assert "potr_cl.codec.decoder" in modules
    assert "pyopencl" not in modules


def test_the_driver_loads_while_other_modules_are_imported():
    """So nothing may come before it that takes long; and an encode without pictures does without Pillow."""
    said = printed(
        "import sys, potr_cl.cli; heavy = {'numpy', 'pyopencl', 'PIL'}; print(sorted(heavy & set(sys.modules)));"
        "import potr_cl.cli.encode; print(sorted(heavy & set(sys.modules)))"
    )
    assert said.splitlines() == ["[]", "['numpy', 'pyopencl']"]


def test_every_command_has_its_help(capsys):
    def told(*words):
        with pytest.raises(SystemExit) as left:
            cli.main(words)
        assert left.value.code == 0
        return capsys.readouterr().out

    listed = told("--help")
    for command in cli.COMMANDS:
        assert f"potr-cl {command}" in told(command, "--help")
        assert re.search(rf"^    {command} ", listed, re.MULTILINE)
    assert told("--version").startswith("potr-cl ")
