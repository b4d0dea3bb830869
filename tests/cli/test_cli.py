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


def test_what_looks_at_no_views_opens_no_device(tmp_path, scene_path, monkeypatch):
    opened = []
    monkeypatch.setattr("potr_cl.workers.host.Device", opened.append)
    assert cli.main(["encode", str(scene_path), "-o", str(tmp_path / "scene.potr"), *KEEP]) == 0
    assert not opened


def test_no_such_input(tmp_path, capsys):
    for command, out in (("encode", "out.potr"), ("decode", "out.ply")):
        fails(capsys, [command, tmp_path / "none.potr", "-o", tmp_path / out], 2, "none.potr")
    fails(capsys, ["info", tmp_path / "none.potr"], 2, "none.potr")
    assert list(tmp_path.iterdir()) == []


def test_directories(tmp_path, scene_path, potr_path, capsys):
    fails(capsys, ["decode", tmp_path, "-o", tmp_path / "out.ply"], 2, str(tmp_path))
    fails(capsys, ["info", tmp_path], 2, str(tmp_path))
    fails(capsys, ["prune", scene_path, "-o", tmp_path], 2, str(tmp_path))
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--report", tmp_path], 2, str(tmp_path))
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


def test_bad_cameras(tmp_path, scene_path, capsys):
    path = tmp_path / "cameras.json"
    path.write_text('{"neither": "nor"}')
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", path], 1, "cameras.json")
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", tmp_path / "no"], 2, "no")
    assert not (tmp_path / "a.potr").exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs resource limits")
def test_disk_full(tmp_path, scene_path, potr_path):
    """A file size limit stands for a full disk: the write fails in the middle."""
    script = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000));"
        "from potr_cl.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    encode = ["encode", scene_path, "-o", tmp_path / "x.potr", *KEEP]
    for arguments in (encode, ["decode", potr_path, "-o", tmp_path / "x.ply"]):
        # -B: compiled modules that it leaves would be cut off as well, and stop whoever imports them next.
        result = subprocess.run(
            [sys.executable, "-B", "-c", script, *map(str, arguments)], capture_output=True, text=True, check=False
        )
        assert result.returncode == 1
        assert "cannot write" in result.stderr
        assert "Traceback" not in result.stderr
        assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply", "scene.potr"]


@pytest.mark.slow
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
        targets = [locked / "a.potr", Path(folder) / "a.potr"]
        calls = [["encode", scene, "-o", targets[0], *KEEP], ["encode", secret, "-o", targets[1], *KEEP]]
        # What takes long looks first.
        few = ["--virtual-views", "4"]
        calls += [["prune", scene, "-o", locked / "a.ply", "--iterations", "1", *few]]
        calls += [["compact", scene, "-o", locked / "a.ply", *few]]
        calls += [["encode", scene, "-o", f"{locked}/", "--ladder", "0.2", *KEEP]]
        command = [sys.executable, "-c", script, json.dumps([[str(word) for word in call] for call in calls])]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        told = json.loads(done.stdout)
        for code, said in told:
            assert code == 2, said
            assert "Permission denied" in said
            assert "Traceback" not in said + done.stderr
        assert not any(target.exists() for target in targets)
        for _, said in told[2:]:
            assert said.startswith("potr-cl: cannot write")
            assert said.endswith("Permission denied\n")
            assert said.count("\n") == 1


def test_interrupt(tmp_path, scene_path, capsys, monkeypatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("potr_cl.api.encoder.run_stages", interrupted)
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", *KEEP], 130, "interrupted")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply"]


def test_decoding_imports_what_decoding_needs(potr_path, tmp_path):
    """To decode takes less time than to open an OpenCL loader."""
    program = "import sys; from potr_cl import cli; code = cli.main(sys.argv[1:]); print(*sys.modules); sys.exit(code)"
    command = [sys.executable, "-c", program, "decode", str(potr_path), "-o", str(tmp_path / "out.ply")]
    modules = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert "potr_cl.codec.decoder" in modules
    assert "pyopencl" not in modules


def test_the_driver_loads_while_other_modules_are_imported():
    """So nothing may come before it that takes long; and an encode without pictures does without Pillow."""
    program = (
        "import sys, potr_cl.cli; heavy = {'numpy', 'pyopencl', 'PIL'}; print(sorted(heavy & set(sys.modules)));"
        "import potr_cl.cli.encode; print(sorted(heavy & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert said.splitlines() == ["[]", "['numpy', 'pyopencl']"]


def test_every_command_has_its_help(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["--help"])
    assert left.value.code == 0
    listed = capsys.readouterr().out
    for command in cli.COMMANDS:
        with pytest.raises(SystemExit) as left:
            cli.main([command, "--help"])
        assert left.value.code == 0
        assert f"potr-cl {command}" in capsys.readouterr().out
        assert re.search(rf"^    {command} ", listed, re.MULTILINE)


def test_module_runs():
    command = [sys.executable, "-m", "potr_cl", "--version"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.startswith("potr-cl ")
