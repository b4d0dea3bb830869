"""Standard input and output: "-" as the name of a scene."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply, spz
from tests.cli.calls import KEEP, cameras_json, program
from tests.reference.scenes import random_scene


@pytest.fixture
def folder(tmp_path, monkeypatch, encoded):
    """The current folder, with scenes and cameras; temporary files have one of their own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    ply.save("a.ply", random_scene(100, 1))
    spz.save("a.spz", random_scene(100, 1))
    Path("a.potr").write_bytes(encoded)
    cameras_json(tmp_path / "cameras.json")
    return tmp_path


@pytest.fixture
def piped(folder, monkeypatch, capfdbinary):
    """Runs a command with a file, or some bytes, as its standard input; nothing is left behind."""

    def run(call, source="a.ply", code=0):
        content = source if isinstance(source, bytes) else Path(source).read_bytes()
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
        assert cli.main(call.split()) == code
        assert list((folder / "temporary").iterdir()) == []
        return capfdbinary.readouterr()

    return run


@pytest.mark.parametrize(
    ("call", "source", "named", "made"),
    [
        ("encode - -o -", "a.ply", "encode a.ply -o b.potr", "b.potr"),
        ("encode - -o -", "a.spz", "encode a.spz -o b.potr", "b.potr"),
        ("decode - -o - --to spz", "a.potr", "decode a.potr -o b.spz", "b.spz"),
        ("convert - - --to .spz", "a.ply", "convert a.ply b.spz", "b.spz"),
        ("prune - -o - --from ply", "a.ply", "prune a.ply -o b.ply", "b.ply"),
    ],
)
def test_the_same_bytes_as_through_files(piped, call, source, named, made):
    more = {"encode": KEEP, "prune": ["--iterations", "2", "--cameras", "cameras.json"]}.get(call.split()[0], [])
    out, err = piped(" ".join([call, *more]), source)
    assert cli.main([*named.split(), *more]) == 0
    assert out == Path(made).read_bytes()
    assert b"splats" in err  # what is said of the result


def test_info_of_standard_input(piped):
    report = json.loads(piped("info - --json", "a.potr").out)
    assert (report["splats"], report["bytes"]) == (200, Path("a.potr").stat().st_size)
    assert report["file"] == "-"


#: An SPZ stream of a few bytes that tells of two billion splats.
BOMB = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 2**31 - 1, 0, 12, 0, 0))


@pytest.mark.parametrize(
    ("call", "source", "code", "said"),
    [
        ("convert - b.ply", b"", 1, "standard input is empty"),
        ("convert - b.ply", b"no scene" * 100, 1, "begins like no scene that is known"),
        ("convert - b.ply --from spz", b"no scene" * 100, 1, "the standard input is not an SPZ file"),
        ("convert - b.ply --from xyz", b"ply\n", 2, "'xyz' is no suffix of a scene"),
        ("convert a.ply b.ply --from ply", b"", 2, "give '-' as the scene"),
        ("convert - b.ply", b"ply\nformat ascii 1.0\nend_header\n", 1, "the standard input"),
        ("convert - b.ply", BOMB, 1, "the standard input"),
        ("decode - -o b.ply", b"ply\nformat ascii 1.0\nend_header\n", 1, "the standard input: not a .potr file"),
        ("convert a.ply - ", b"", 2, "--to is missing"),
        ("refit - --reference - -o b.ply", b"ply\n", 2, "given twice"),
        ("encode - -o - --json", b"ply\n", 2, "both want standard output"),
        ("encode - -o .", b"ply\n", 2, "has no name to take over"),
    ],
)
def test_what_cannot_be(piped, call, source, code, said):
    out, err = piped(call, source, code)
    assert said in err.decode()
    assert err.startswith(b"potr-cl: ")
    assert err.count(b"\n") == 1
    assert out == b""
    assert not Path("b.ply").exists()


@pytest.mark.parametrize(
    ("writes", "call", "code", "said"),
    [
        ("while True: sys.stdout.buffer.write(bytes(1 << 16))", ["info", "-"], 1, "begins like no scene"),
        # Nothing comes, and nothing ends, and yet the command does.
        ("import time; time.sleep(400)", ["encode", "-", "-o", "b.potr", "-q", "7"], 2, "quality"),
    ],
)
def test_a_stream_without_an_end_is_not_waited_for(tmp_path, writes, call, code, said):
    command = [sys.executable, "-c", f"import sys\n{writes}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as endless:
        result = program(*call, cwd=tmp_path, capture_output=False, stdin=endless.stdout, stderr=subprocess.PIPE)
        endless.kill()
    assert result.returncode == code
    assert said in result.stderr


def test_what_is_logged_speaks_of_standard_input(piped):
    scene = random_scene(20)
    scene.means[3] = np.nan
    ply.save("b.ply", scene)
    assert b"the standard input: dropped 1 splats" in piped("convert - c.ply", "b.ply").err


def test_a_file_that_is_called_minus(piped):
    Path("-").write_bytes(Path("a.potr").read_bytes())
    piped("decode ./- -o b.ply", b"")
    assert len(load_scene("b.ply")) == 200


FULL = r"(octree.*\n|entropy.*\n)*potr-cl: cannot write to (the )?standard output: .*\n"
CLOSED = r"potr-cl: standard output is closed: redirect it.*\n"
HEAD = r"(ply\nformat|-: 200 splats.*\n)+0\n"
GONE = '{ sleep 0; "$@"; echo "exit code $?" >&2; } | true'
ENCODE = f"encode a.ply {' '.join(KEEP)} -o"


#: Only the first two of these are quick.
CASES = [
    ('"$@" > /dev/full', f"{ENCODE} -", 1, FULL),
    ('"$@" | head -c 10 >&2; echo ${PIPESTATUS[0]} >&2', "decode a.potr -o -", 0, HEAD),
    (GONE, f"{ENCODE} -", 0, rf"{FULL}exit code 1\n"),
    *((GONE, call, 0, r"exit code 0\n") for call in ("info a.potr", "encode --help")),
    *(('"$@" > /dev/full', call, 1, FULL) for call in ("info a.potr --json", "encode --help")),
    *(('"$@" >&-', call, 1, CLOSED) for call in ("info a.potr", "--version")),
    ('"$@" >&-', f"{ENCODE} -", 2, CLOSED),
    # As under a supervisor that closes it: what is only told beside the result is not.
    ('"$@" >&-', "decode a.potr -o b.ply", 0, ""),
    ('"$@" <&-', "encode - -o b.potr", 2, r"potr-cl: standard input is closed: pipe a scene into .*\n"),
    ('"$@" 2> /dev/full', f"{ENCODE} b.potr", 0, ""),
    ('"$@" 2> /dev/full', "info none", 2, ""),
    ('"$@" 2>&- <&-', "decode a.potr -o b.ply", 0, ""),
]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize(
    ("shell", "call", "code", "said"),
    [pytest.param(*case, marks=[pytest.mark.slow][: n > 1]) for n, case in enumerate(CASES)],
)
def test_streams_that_are_full_closed_or_gone(folder, shell, call, code, said):
    result = program(*call.split(), shell=shell, cwd=folder)
    assert result.returncode == code, result.stderr
    assert re.fullmatch(said, result.stderr), result.stderr
