"""Whatever is typed or stands in a file: one line that does no harm, the right exit code, valid JSON."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potr_cl import cli, formats
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError, PotrError
from potr_cl.formats.scenes import ply
from tests.reference.scenes import random_scene

ROOT = Path(__file__).parents[2]
KEEP = ["--no-prune", "--no-compact", "--refit", "off", "--no-quality"]
#: Sets a terminal's title, turns the direction of writing, ends the line, and cannot be written as UTF-8.
ESCAPES = "\x1b]0;title\x07\u202e\r\n\ud800"


@pytest.fixture
def scene_path(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    scene = random_scene(20, 0)
    # Where the excerpt's cameras look.
    ply.save(path, dataclasses.replace(scene, means=(0.05 * scene.means + [-0.76, 1.57, 2.78]).astype(np.float32)))
    return path


@pytest.fixture
def potr_path(tmp_path: Path) -> Path:
    path = tmp_path / "a.potr"
    parameters = HyperParameters.from_quality(0.5, "paper")
    path.write_bytes(b"".join(code_scene(random_scene(20, 0), parameters).pieces))
    return path


def outcome(capsys: pytest.CaptureFixture[str], arguments: Sequence[object], lines: int = 1) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a call; all of it harmless, errors one line.

    Args:
        lines: that standard error has at most where the call fails; the last one is the error.
    """
    try:
        code = cli.main([str(argument) for argument in arguments])
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 99
    said = capsys.readouterr()
    for line in [*said.out.split("\n"), *said.err.split("\n")]:
        assert line.isprintable(), line
        assert len(line) <= 1000
    if code:
        assert said.err.splitlines()[-1].startswith("potr-cl")
        assert sum(line.startswith("potr-cl") for line in said.err.splitlines()) == 1
        assert said.err.count("\n") <= lines
        assert "unforeseen" not in said.err
    return code, said.out, said.err


MANY_DIGITS = "9" * 5000


NO_NUMBERS = [
    *(["--memory", value] for value in ("nan", "inf", "-inf", "1e300", "1e400", "-1")),
    *(["--max-size", value] for value in ("1e400", "1e17GB", MANY_DIGITS, "nan", "inf")),
    *([flag, value] for flag in ("-q", "--min-psnr", "--gamma", "--drop") for value in ("nan", "inf", "1e400")),
    *(["--tolerance", value] for value in ("nan", "inf")),
    ["--tolerance=-inf"],
    *([flag, MANY_DIGITS] for flag in ("--refit", "--count", "--iterations", "--threads", "--turns")),
    *([f"{flag}=-{MANY_DIGITS}"] for flag in ("--refit", "--count", "--iterations", "--threads", "--turns")),
    *([flag, "²"] for flag in ("--refit", "--count", "--iterations", "--zstd-level", "--virtual-views")),
    *(["--zstd-level", "99999999999"], ["--background", "nan,0,0"], ["--background", "x" * 5000]),
    *(["--preset", ESCAPES], [f"--{ESCAPES}"], [ESCAPES]),
]


def test_numbers_that_are_none(tmp_path, scene_path, capsys):
    for options in NO_NUMBERS:
        code, out, _ = outcome(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", *options])
        assert (code, out) == (2, ""), options
        assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


@pytest.mark.parametrize("number", ["0", "4001", "100000000", MANY_DIGITS])
@pytest.mark.parametrize("command", ["encode", "prune"])
def test_virtual_views_are_bounded(
    tmp_path: Path, scene_path: Path, capsys: pytest.CaptureFixture[str], command: str, number: str
) -> None:
    out = tmp_path / ("a.potr" if command == "encode" else "a.ply")
    arguments = [command, scene_path, "-o", out, "--virtual-views", number]
    # A line that tells of placing may stand before the error's.
    assert outcome(capsys, arguments, lines=3)[0] == 2
    assert not out.exists()


@pytest.mark.parametrize("device", ["²", "٣٣٣", MANY_DIGITS, "-1", ESCAPES])
def test_devices_that_there_are_not(tmp_path, scene_path, capsys, data, device):
    cameras = ["--cameras", data / "plush_excerpt_cameras.json"]
    code, _, err = outcome(capsys, ["render", scene_path, *cameras, "-o", tmp_path / "d", f"--device={device}"])
    assert code == 1
    assert "no OpenCL device fits" in err


def calls(name: str, good: str) -> list[list[str]]:
    """A name in every place of every command that takes one, beside good ones."""
    cameras = str(ROOT / "tests" / "data" / "plush_excerpt_cameras.json")
    return [
        ["encode", name, "-o", "new.potr"],
        ["encode", good, "-o", name, *KEEP],
        ["encode", good, "-o", "new.potr", "--report", name, *KEEP],
        ["encode", good, "-o", "new.potr", "--cameras", name],
        ["encode", good, "-o", "new.potr", "--cameras", cameras, "--photos", name],
        ["decode", name, "-o", "new.ply"],
        ["info", name],
        ["convert", name, "new.ply"],
        ["convert", good, name],
        ["prune", name, "-o", "new.ply"],
        ["prune", good, "-o", "new.ply", "--order", name],
        ["refit", good, "--reference", name, "-o", "new.ply"],
        ["fit", good, "--reference", name, "-o", "new.ply"],
        ["render", name, "--cameras", cameras, "-o", "new"],
        ["render", good, "--cameras", name, "-o", "new"],
        ["render", good, "--cameras", cameras, "-o", name, "--views", "0"],
        ["compare", good, name],
        ["compare", good, good, "--cameras", cameras, "--truth", name],
        ["compare", good, good, "--cameras", cameras, "-o", name, "--views", "0"],
    ]


NAMES = ["x" * 300 + ".ply", "loop.ply", "no/such\x1b\udcff/folder.ply"]


@pytest.mark.parametrize(
    ("number", "name"),
    [*((number, NAMES[number % 3]) for number in range(len(calls("", "")))), (0, NAMES[1]), (8, NAMES[0])],
)
def test_names_that_cannot_be(tmp_path, scene_path, capsys, monkeypatch, name, number):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    arguments = calls(name, "scene.ply")[number]
    if name.startswith("no/") and arguments[0] == "render" and arguments.index(name) > 2 and "-o" in arguments[-4:-2]:
        return  # this folder can be made
    code, _, _ = outcome(capsys, list(arguments))
    assert code == 2
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "new") == ["loop.ply", "scene.ply"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="names are Unicode there")
def test_a_name_that_is_not_utf_8(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    odd = os.fsdecode(b"odd\xff\x1b[31m")
    ply.save(f"{odd}.ply", random_scene(20, 0))
    encode: list[object] = ["encode", f"{odd}.ply", "-o", f"{odd}.potr", "--report", f"{odd}.html", *KEEP]
    assert outcome(capsys, encode)[0] == 0
    page = Path(f"{odd}.html").read_bytes().decode("utf-8")
    assert "odd\\udcff\\x1b[31m.ply" in page
    code, out, _ = outcome(capsys, [*encode, "--json"])
    assert code == 0
    assert json.loads(out)["file"] == "odd\\udcff\\x1b[31m.potr"
    for arguments in (
        ["info", f"{odd}.potr"],
        ["decode", f"{odd}.potr", "-o", f"{odd}.ply"],
        ["compare", f"{odd}.ply", f"{odd}.potr"],
        ["convert", f"{odd}.potr", f"{odd}.ply"],
    ):
        assert outcome(capsys, list(arguments))[0] == 0
    assert outcome(capsys, ["info", odd])[0] == 2


METADATA = {
    "escapes": {"q": ESCAPES, "cameras": ESCAPES, "source_bytes": 5},
    "400 digits": {"source_bytes": 10**400, "q": 10**400},
    "not finite": {"q": float("nan"), "gamma": float("inf"), "beta": -float("inf")},
    "other kinds": {"q": [ESCAPES], "cameras": {ESCAPES: 1}, "source_bytes": True, "source_splats": "x" * 60_000},
    "unknown keys": {ESCAPES: ESCAPES, "x" * 60_000: 1},
}


@pytest.mark.parametrize("metadata", METADATA)
def test_metadata_does_no_harm(tmp_path: Path, capsys: pytest.CaptureFixture[str], metadata: str) -> None:
    """Whether a reader refuses it or shows it."""
    path = tmp_path / "a.potr"
    parameters = HyperParameters.from_quality(0.5, "paper")
    text = json.dumps(METADATA[metadata]).encode()
    path.write_bytes(b"".join(code_scene(random_scene(20, 0), parameters, metadata=text).pieces))
    code, _, _ = outcome(capsys, ["info", path])
    assert code in (0, 1)
    code, out, _ = outcome(capsys, ["info", path, "--json"])
    if code == 0:
        report = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
        assert report["splats"] == 20


@pytest.mark.parametrize(
    "header",
    [
        f"format binary_little_endian 1.0\nelement {ESCAPES} 1\nproperty float x\nend_header\n",
        f"format binary_little_endian 1.0\nelement vertex 1\nproperty {ESCAPES} x\nend_header\n",
        f"format {ESCAPES} 1.0\nelement vertex 1\nproperty float x\nend_header\n",
        "format binary_little_endian 1.0\nelement vertex 1\n"
        + "".join(f"property float f_rest_{'x' * 200}{k}\n" for k in range(300))
        + "end_header\n",
    ],
)
def test_names_in_a_ply_do_no_harm(tmp_path: Path, capsys: pytest.CaptureFixture[str], header: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\n" + header.replace("\r\n", "").encode("latin-1", "replace") + bytes(4000))
    assert outcome(capsys, ["convert", path, tmp_path / "b.ply"])[0] == 1


def test_errors_that_nobody_foresaw_are_one_line(
    scene_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_path: object, **_keywords: object) -> None:
        raise RuntimeError(f"{ESCAPES}{'x' * 60_000}")

    monkeypatch.setattr("potr_cl.formats.load_scene", fail)
    assert cli.main(["convert", str(scene_path), "b.ply"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("potr-cl: unforeseen RuntimeError: \\x1b")
    assert len(said) < 1200
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, "1")
    assert cli.main(["convert", str(scene_path), "b.ply"]) == 1
    said = capsys.readouterr().err
    assert "in fail" in said
    assert all(line.isprintable() for line in said.split("\n"))


def test_a_scene_that_does_not_fit_the_memory(
    scene_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for error in (MemoryError(), OSError(12, "Cannot allocate memory"), ImportError("failed to map segment")):

        def fail(_path: object, error: Exception = error, **_keywords: object) -> None:
            raise error

        monkeypatch.setattr("potr_cl.formats.load_scene", fail)
        assert cli.main(["convert", str(scene_path), "b.ply"]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert said.startswith("potr-cl: ")
        assert (str(error.args[-1]) if error.args else "not enough memory for this scene") in said


# ------------------------------------------------------------------------------------------ what was made is proved


def unreadable(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object, **_keywords: object) -> None:
        raise DataError("the octree's origin is not finite")

    monkeypatch.setattr("potr_cl.codec.body.Body.decode_into", refuse)


def test_a_file_that_cannot_be_decoded_replaces_nothing(
    tmp_path: Path, scene_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "a.potr"
    out.write_bytes(b"precious")
    unreadable(monkeypatch)
    assert cli.main(["encode", str(scene_path), "-o", str(out), *KEEP]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("potr-cl: the encoded file cannot be decoded (the octree's origin is not finite)")
    assert out.read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.potr", "scene.ply"]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("preset", ["paper", "fast"])
def test_extreme_scenes_are_encoded_or_refused(tmp_path, capsys, preset):
    """Positions and logarithms of scales that come near to float32's limits."""
    one = np.array([1.0, -1.0, 1.0])
    extremes = [*((one * size, 0 * one) for size in (1e37, 1e38, 2e38, 3e38, 3.4e38))]
    extremes += [(0 * one, one * size) for size in (-1e4, -87.0, 80.0, 88.7, 300.0)]
    source, out, back = (tmp_path / each for each in ("i.ply", "o.potr", "back.ply"))
    for means, log_scales in extremes:
        scene = random_scene(20, 0)
        scene.means[:2] = means.astype(np.float32) * np.array([[1], [-1]], np.float32)
        scene.log_scales[:2] = log_scales.astype(np.float32)
        ply.save(source, scene)
        code = cli.main(["encode", str(source), "-o", str(out), "--preset", preset, *KEEP])
        said = capsys.readouterr().err.splitlines()
        if code == 0:
            assert cli.main(["decode", str(out), "-o", str(back)]) == 0
            out.unlink()
            back.unlink()
            continue
        assert code == 1
        assert said[-1].startswith("potr-cl: ")
        assert "unforeseen" not in said[-1]
        assert [path.name for path in tmp_path.iterdir()] == ["i.ply"]


def test_a_scene_that_is_removed_meanwhile(
    tmp_path: Path, scene_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was read is enough."""
    size = scene_path.stat().st_size
    load = formats.load_scene

    def load_and_remove(path: Path, **keywords: Any) -> object:
        scene = load(path, **keywords)
        path.unlink()
        return scene

    monkeypatch.setattr("potr_cl.formats.load_scene", load_and_remove)
    arguments: list[object] = ["encode", scene_path, "-o", tmp_path / "a.potr", "--json", *KEEP]
    code, out, _ = outcome(capsys, arguments)
    assert code == 0
    assert json.loads(out)["source"]["bytes"] == size
    for command in (["convert", "{}", "b.ply"], ["compare", "{}", "{}"]):
        ply.save(scene_path, random_scene(20, 0))
        monkeypatch.chdir(tmp_path)
        assert cli.main([word.format(scene_path) for word in command]) in (0, 1, 2)
        assert "Traceback" not in capsys.readouterr().err


def test_trust_reaches_the_readers(
    tmp_path: Path,
    scene_path: Path,
    potr_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []

    def ask(path: object, trust: bool = False, **_keywords: object) -> None:
        asked.append(trust)
        raise PotrError("enough")

    for reader in ("formats.load_scene", "api.describing.load_scene", "formats.load_scene"):
        monkeypatch.setattr(f"potr_cl.{reader}", ask)
    for module in ("api.files", "api.describing", "codec.decoder"):
        monkeypatch.setattr(f"potr_cl.{module}.open_file", ask)
    cameras = str(ROOT / "tests" / "data" / "plush_excerpt_cameras.json")
    scene, out = str(scene_path), str(tmp_path / "out.ply")
    for command in (
        ["encode", scene, "-o", str(tmp_path / "out.potr"), *KEEP],
        ["decode", scene, "-o", out],
        ["info", scene],
        ["info", str(potr_path)],
        ["convert", scene, out],
        ["prune", scene, "-o", out],
        ["compact", scene, "-o", out],
        ["refit", scene, "--reference", scene, "-o", out],
        ["fit", scene, "--reference", scene, "-o", out],
        ["render", scene, "--cameras", cameras, "-o", out],
        ["compare", scene, scene],
    ):
        asked.clear()
        assert cli.main(command) == 1
        assert cli.main([*command, "--trust"]) == 1
        assert asked == [False, True], command[0]
    capsys.readouterr()


# ------------------------------------------------------------------------------------------ where it is printed


def run(shell: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """The program in a shell; "$@" of the command line stands for it and its arguments."""
    command = [sys.executable, "-m", "potr_cl", *map(str, arguments)]
    return subprocess.run(
        ["sh", "-c", shell, "sh", *command],
        cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


needs_posix = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")


@pytest.mark.slow
@needs_posix
@pytest.mark.parametrize("closed", ["2> /dev/full", "2>&-", "2>&- <&-"])
def test_standard_error_is_not_needed(tmp_path: Path, scene_path: Path, closed: str) -> None:
    out = tmp_path / "a.potr"
    result = run(f'"$@" {closed}', "encode", scene_path, "-o", out, *KEEP)
    assert result.returncode == 0
    assert str(out) in result.stdout
    assert cli.main(["decode", str(out), "-o", str(tmp_path / "b.ply")]) == 0
    result = run(f'"$@" {closed}', "info", "nothing.potr")
    assert result.returncode == 2
    assert result.stdout == ""


FULL = "potr-cl: cannot write to the standard output: No space left on device\n"
CLOSED = "potr-cl: standard output is closed: redirect it.*\n"


@pytest.mark.slow
@needs_posix
@pytest.mark.parametrize(
    ("shell", "command", "code", "said"),
    [
        *(('"$@" > /dev/full', call, [1], FULL) for call in ("info {}", "info {} --json", "encode --help")),
        *(('"$@" >&-', call, [1, 2], CLOSED) for call in ("info {}", "decode {} -o -", "encode {} -o -", "--version")),
        # As under a supervisor that closes it: what is only told beside the result is not.
        ('"$@" >&-', "decode {} -o {}.ply", [0], ""),
        ('"$@" <&-', "encode - -o {}.new", [2], "potr-cl: standard input is closed: pipe a scene into it, or .*\n"),
        *(
            ('{ sleep 0; "$@"; echo "exit code $?" >&2; } | true', call, [0], "exit code 0\n")
            for call in ("info {}", "encode --help")
        ),
    ],
)
def test_streams_that_are_full_closed_or_gone(potr_path, shell, command, code, said):
    result = run(shell, *command.replace("{}", str(potr_path)).split())
    assert result.returncode in code
    assert re.fullmatch(said, result.stderr), result.stderr


def test_numbers_beyond_single_precision_are_no_news(tmp_path: Path, potr_path: Path) -> None:
    """Neither of a box nor of a scene, whose centres are far and whose colours are absurd."""
    scene = random_scene(20, 1)
    scene.means[:] *= np.float32(1e30)
    scene.sh[:, 1] = np.float32(3e38)
    ply.save(tmp_path / "a.ply", scene)
    box = [*["-1e39"] * 3, *["1e39"] * 3]
    for words in (
        ["decode", potr_path, "-o", tmp_path / "b.ply", "--box", *box],
        ["info", tmp_path / "a.ply"],
        ["convert", tmp_path / "a.ply", tmp_path / "b.compressed.ply"],
    ):
        result = run('"$@"', *words)
        assert (result.returncode, result.stderr) == (0, ""), words


def test_a_terminal_of_another_alphabet(tmp_path: Path, potr_path: Path) -> None:
    result = run('"$@"', "decode", potr_path, "-o", tmp_path / "é中.ply", PYTHONIOENCODING="ascii")
    assert result.returncode == 0
    assert "\\xe9\\u4e2d.ply: 20 splats" in result.stdout
    assert result.stderr == ""


def test_log_records_of_files_are_plain(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    scene = random_scene(20, 0)
    scene.means[3] = np.nan
    path = tmp_path / "a\x1b[31m.ply"
    ply.save(path, scene)
    with caplog.at_level(logging.WARNING, "potr_cl"):
        ply.load(path)
    assert "a\\x1b[31m.ply': dropped 1 splats" in caplog.text
