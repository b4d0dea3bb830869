"""Standard input and output: "-" as the name of a scene."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply, spz
from tests.cli.calls import KEEP, cameras_json
from tests.reference.scenes import random_scene

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    ply.save(tmp_path / "a.ply", random_scene(100, 1))
    spz.save(tmp_path / "a.spz", random_scene(100, 1))
    cameras_json(tmp_path / "cameras.json")
    assert cli.main(["encode", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.potr"), *KEEP]) == 0
    capsys.readouterr()
    return tmp_path


def piped(folder: Path, call: str, source: str | bytes = "a.ply", code: int = 0) -> subprocess.CompletedProcess[bytes]:
    """Run a command with a file, or some bytes, as its standard input; nothing is left behind."""
    content = source if isinstance(source, bytes) else (folder / source).read_bytes()
    temporary = folder / "temporary"
    temporary.mkdir(exist_ok=True)
    result = subprocess.run(
        [sys.executable, "-m", "potr_cl", *call.split()],
        input=content,
        capture_output=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)},
        check=False,
    )
    assert result.returncode == code, result.stderr
    assert b"Traceback" not in result.stderr
    assert list(temporary.iterdir()) == []
    return result


@pytest.mark.slow
@pytest.mark.parametrize(
    ("call", "source"),
    [
        (f"encode - -o - {' '.join(KEEP)}", "a.ply"),
        (f"encode - -o - {' '.join(KEEP)}", "a.spz"),
        ("decode - -o - --to spz", "a.potr"),
        ("convert - - --to .spz", "a.ply"),
        ("prune - -o - --from ply --iterations 2 --cameras cameras.json", "a.ply"),
    ],
)
def test_the_same_bytes_as_through_files(folder: Path, monkeypatch: pytest.MonkeyPatch, call: str, source: str) -> None:
    result = piped(folder, call, source)
    suffix = ".potr" if call.startswith("encode") else ".spz" if "spz" in call else ".ply"
    named = [source if word == "-" else word for word in call.split() if word not in ("--to", "--from")]
    named = [word for word in named if word.strip(".") not in ("spz", "ply")]
    if "-o" in named:
        named[named.index("-o") + 1] = f"out{suffix}"
    else:
        named[2] = f"out{suffix}"
    monkeypatch.chdir(folder)
    assert cli.main(named) == 0
    assert result.stdout == (folder / f"out{suffix}").read_bytes()
    assert b"splats" in result.stderr  # what is said of the result


def test_info_of_standard_input(folder: Path) -> None:
    report = json.loads(piped(folder, "info - --json", "a.potr").stdout)
    assert (report["splats"], report["bytes"]) == (100, (folder / "a.potr").stat().st_size)
    assert report["file"] == "-"


@pytest.mark.parametrize(
    ("call", "source", "code", "said"),
    [
        ("convert - b.ply", b"", 1, "standard input is empty"),
        ("convert - b.ply", b"no scene" * 100, 1, "begins like no scene that is known"),
        ("convert - b.ply --from spz", b"no scene" * 100, 1, "the standard input is not an SPZ file"),
        ("convert - b.ply --from xyz", b"ply\n", 2, "'xyz' is no suffix of a scene"),
        ("convert a.ply b.ply --from ply", b"", 2, "give '-' as the scene"),
        ("convert - b.ply", b"ply\nformat ascii 1.0\nend_header\n", 1, "the standard input"),
        ("decode - -o b.ply", b"ply\nformat ascii 1.0\nend_header\n", 1, "the standard input': not a .potr file"),
        ("convert a.ply - ", b"", 2, "--to is missing"),
        ("refit - --reference - -o b.ply", b"ply\n", 2, "given twice"),
        ("encode - -o - --json", b"ply\n", 2, "both want standard output"),
        ("encode - -o .", b"ply\n", 2, "has no name to take over"),
    ],
)
def test_what_cannot_be(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    call: str,
    source: bytes,
    code: int,
    said: str,
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(source)))
    assert cli.main(call.split()) == code
    out, err = capsys.readouterr()
    assert said.replace("':", ":") in err
    assert err.startswith("potr-cl: ")
    assert err.count("\n") == 1
    assert out == ""
    assert not (folder / "b.ply").exists()


def test_a_claim_of_a_stream_is_checked_as_that_of_a_file(folder: Path) -> None:
    """An SPZ stream of a few bytes that tells of two billion splats."""
    import gzip
    import struct

    bomb = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 2**31 - 1, 0, 12, 0, 0))
    assert b"the standard input" in piped(folder, "convert - b.ply", bomb, 1).stderr


def test_an_endless_stream_that_is_no_scene_is_not_read_to_its_end(folder: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", "import sys\nwhile True: sys.stdout.buffer.write(bytes(1 << 16))"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as endless:
        result = subprocess.run(
            [sys.executable, "-m", "potr_cl", "info", "-"],
            stdin=endless.stdout,
            capture_output=True,
            cwd=ROOT,
            timeout=300,
            check=False,
        )
        endless.kill()
    assert result.returncode == 1
    assert b"begins like no scene" in result.stderr


def test_a_wrong_option_is_told_before_anything_is_read(folder: Path) -> None:
    """Nothing comes, and nothing ends, and yet the command does."""
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(400)"], stdout=subprocess.PIPE) as silent:
        result = subprocess.run(
            [sys.executable, "-m", "potr_cl", "encode", "-", "-o", str(folder / "b.potr"), "-q", "7"],
            stdin=silent.stdout,
            capture_output=True,
            cwd=ROOT,
            timeout=300,
            check=False,
        )
        silent.kill()
    assert result.returncode == 2
    assert b"quality" in result.stderr


def test_what_is_logged_speaks_of_standard_input(folder: Path) -> None:
    scene = random_scene(20)
    scene.means[3] = np.nan
    ply.save(folder / "b.ply", scene)
    said = piped(folder, "convert - c.ply", "b.ply").stderr.decode()
    assert "the standard input: dropped 1 splats" in said


def test_a_file_that_is_called_minus(folder: Path) -> None:
    (folder / "-").write_bytes((folder / "a.potr").read_bytes())
    piped(folder, "decode ./- -o b.ply", b"")
    assert len(load_scene(folder / "b.ply")) == 100


@pytest.mark.skipif(os.name != "posix", reason="needs a shell's pipes")
def test_who_reads_the_result_may_go_early(folder: Path) -> None:
    script = f"{sys.executable} -m potr_cl decode a.potr -o - | head -c 10; echo; echo ${{PIPESTATUS[0]}}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        ["bash", "-c", script], capture_output=True, cwd=folder, env=environment, check=False, timeout=300
    )
    assert result.stdout == b"ply\nformat\n0\n"
    assert b"Traceback" not in result.stderr
    assert b"rror" not in result.stderr
