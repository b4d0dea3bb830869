"""Whatever is typed or stands in a file: one line that does no harm, the right exit code, valid JSON."""

from __future__ import annotations

import io
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl import cli, formats
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError, PotrError
from potr_cl.formats.scenes import ply
from tests.cases.own_warnings import no_warnings
from tests.cli.calls import KEEP, cameras_json, fails, program
from tests.reference.scenes import random_scene

#: Sets a terminal's title, turns the direction of writing, ends the line, and cannot be written as UTF-8.
ESCAPES = "\x1b]0;title\x07\u202e\r\n\ud800"


@pytest.fixture
def small(tmp_path, monkeypatch):
    """The current folder, with nothing but a small scene."""
    monkeypatch.chdir(tmp_path)
    ply.save("scene.ply", random_scene(20, 0))
    return tmp_path


def names(folder="."):
    return sorted(path.name for path in Path(folder).iterdir())


def outcome(capsys, arguments, lines=1):
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


def test_numbers_that_are_none(small, capsys):
    for options in NO_NUMBERS:
        code, out, _ = outcome(capsys, ["encode", "scene.ply", "-o", "a.potr", *options])
        assert (code, out) == (2, ""), options
        assert names() == ["scene.ply"]


@pytest.mark.parametrize(
    ("command", "number"), [("encode", "0"), ("prune", "4001"), ("encode", "100000000"), ("prune", MANY_DIGITS)]
)
def test_virtual_views_are_bounded(small, capsys, command, number):
    out = "a.potr" if command == "encode" else "a.ply"
    # A line that tells of placing may stand before the error's.
    assert outcome(capsys, [command, "scene.ply", "-o", out, "--virtual-views", number], lines=3)[0] == 2
    assert names() == ["scene.ply"]


@pytest.mark.parametrize("device", ["²", "٣٣٣", MANY_DIGITS, "-1", ESCAPES])
def test_devices_that_there_are_not(scene_path, cameras_path, capsys, device):
    call = ["render", scene_path, "--cameras", cameras_path, "-o", scene_path.parent / "d", f"--device={device}"]
    code, _, err = outcome(capsys, call)
    assert code == 1
    assert "no OpenCL device fits" in err


#: A name in every place of every command that takes one, beside good ones.
PLACES = f"""
encode NAME -o new.potr
encode scene.ply -o NAME {" ".join(KEEP)}
encode scene.ply -o new.potr --report NAME {" ".join(KEEP)}
encode scene.ply -o new.potr --cameras NAME
encode scene.ply -o new.potr --cameras cameras.json --photos NAME
decode NAME -o new.ply
info NAME
convert NAME new.ply
convert scene.ply NAME
prune NAME -o new.ply
prune scene.ply -o new.ply --order NAME
refit scene.ply --reference NAME -o new.ply
fit scene.ply --reference NAME -o new.ply
render NAME --cameras cameras.json -o new
render scene.ply --cameras NAME -o new
render scene.ply --cameras cameras.json -o NAME --views 0
compare scene.ply NAME
compare scene.ply scene.ply --cameras cameras.json --truth NAME
compare scene.ply scene.ply --cameras cameras.json -o NAME --views 0
""".strip().splitlines()
NAMES = ["x" * 300 + ".ply", "loop.ply", "no/such\x1b\udcff/folder.ply"]


@pytest.mark.parametrize(
    ("place", "name"),
    # But for a folder that can be made.
    [*((place, NAMES[0 if "-o NAME --views" in place else n % 3]) for n, place in enumerate(PLACES)),
     (PLACES[0], NAMES[1]), (PLACES[8], NAMES[0])],
)  # fmt: skip
def test_names_that_cannot_be(small, cameras_path, capsys, name, place):
    Path("loop.ply").symlink_to("loop.ply")
    code, _, _ = outcome(capsys, [name if word == "NAME" else word for word in place.split()])
    assert code == 2
    assert set(names()) - {"new"} == {"cameras.json", "loop.ply", "scene.ply"}


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="names are Unicode there")
def test_a_name_that_is_not_utf_8(small, capsys):
    odd = os.fsdecode(b"odd\xff\x1b[31m")
    Path("scene.ply").rename(f"{odd}.ply")
    encode = ["encode", f"{odd}.ply", "-o", f"{odd}.potr", "--report", f"{odd}.html", *KEEP]
    code, out, _ = outcome(capsys, [*encode, "--json"])
    assert code == 0
    assert json.loads(out)["file"] == "odd\\udcff\\x1b[31m.potr"
    assert "odd\\udcff\\x1b[31m.ply" in Path(f"{odd}.html").read_bytes().decode("utf-8")
    for arguments in (
        encode,
        ["info", f"{odd}.potr"],
        ["decode", f"{odd}.potr", "-o", f"{odd}.ply"],
        ["compare", f"{odd}.ply", f"{odd}.potr", "--cameras", str(cameras_json(small / "cameras.json", 1))],
        ["convert", f"{odd}.potr", f"{odd}.ply"],
    ):
        assert outcome(capsys, arguments, lines=9)[0] == 0
    assert outcome(capsys, ["info", odd])[0] == 2


METADATA = {
    "escapes": {"q": ESCAPES, "cameras": ESCAPES, "source_bytes": 5},
    "400 digits": {"source_bytes": 10**400, "q": 10**400},
    "not finite": {"q": float("nan"), "gamma": float("inf"), "beta": -float("inf")},
    "other kinds": {"q": [ESCAPES], "cameras": {ESCAPES: 1}, "source_bytes": True, "source_splats": "x" * 60_000},
    "unknown keys": {ESCAPES: ESCAPES, "x" * 60_000: 1},
}


@pytest.mark.parametrize("metadata", METADATA)
def test_metadata_does_no_harm(tmp_path, capsys, metadata):
    """Whether a reader refuses it or shows it."""
    path = tmp_path / "a.potr"
    parameters = HyperParameters.from_quality(0.5, "paper")
    text = json.dumps(METADATA[metadata]).encode()
    path.write_bytes(b"".join(code_scene(random_scene(20, 0), parameters, metadata=text).pieces))
    assert outcome(capsys, ["info", path])[0] in (0, 1)
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
def test_names_in_a_ply_do_no_harm(tmp_path, capsys, header):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\n" + header.replace("\r\n", "").encode("latin-1", "replace") + bytes(4000))
    assert outcome(capsys, ["convert", path, tmp_path / "b.ply"])[0] == 1


def failing(monkeypatch, where, error):
    """Have a function of the package fail."""

    def fail(*_args, **_keywords):
        raise error

    monkeypatch.setattr(f"potr_cl.{where}", fail)


def test_errors_that_nobody_foresaw_are_one_line(small, capsys, monkeypatch):
    failing(monkeypatch, "formats.load_scene", RuntimeError(f"{ESCAPES}{'x' * 60_000}"))
    assert cli.main(["convert", "scene.ply", "b.ply"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("potr-cl: unforeseen RuntimeError: \\x1b")
    assert len(said) < 1200
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, "1")
    assert cli.main(["convert", "scene.ply", "b.ply"]) == 1
    said = capsys.readouterr().err
    assert "in fail" in said
    assert all(line.isprintable() for line in said.split("\n"))


@pytest.mark.parametrize(
    "error", [MemoryError(), OSError(12, "Cannot allocate memory"), ImportError("failed to map segment")], ids=repr
)
def test_a_scene_that_does_not_fit_the_memory(small, capsys, monkeypatch, error):
    failing(monkeypatch, "formats.load_scene", error)
    said = error.args[-1] if error.args else "not enough memory for this scene"
    fails(capsys, ["convert", "scene.ply", "b.ply"], 1, said)


# ------------------------------------------------------------------------------------------ what was made is proved


def test_a_file_that_cannot_be_decoded_replaces_nothing(small, capsys, monkeypatch):
    Path("a.potr").write_bytes(b"precious")
    failing(monkeypatch, "codec.body.Body.decode_into", DataError("the octree's origin is not finite"))
    said = "the encoded file cannot be decoded (the octree's origin is not finite)"
    fails(capsys, ["encode", "scene.ply", "-o", "a.potr", *KEEP], 1, said)
    assert Path("a.potr").read_bytes() == b"precious"
    assert names() == ["a.potr", "scene.ply"]


def test_a_scene_that_is_removed_meanwhile(small, capsys, monkeypatch):
    """What was read is enough."""
    scene = Path("scene.ply")
    content, load = scene.read_bytes(), formats.load_scene

    def load_and_remove(path, **keywords):
        scene = load(path, **keywords)
        path.unlink()
        return scene

    monkeypatch.setattr("potr_cl.formats.load_scene", load_and_remove)
    code, out, _ = outcome(capsys, ["encode", scene, "-o", "a.potr", "--json", *KEEP])
    assert code == 0
    assert json.loads(out)["source"]["bytes"] == len(content)
    scene.write_bytes(content)
    assert outcome(capsys, ["convert", scene, "b.ply"])[0] == 0
    assert len(load(Path("b.ply"))) == 20


def test_trust_reaches_the_readers(tmp_path, scene_path, potr_path, cameras_path, capsys, monkeypatch):
    asked = []

    def ask(path, trust=False, **_keywords):
        asked.append(trust)
        raise PotrError("enough")

    for reader in ("formats", "api.describing"):
        monkeypatch.setattr(f"potr_cl.{reader}.load_scene", ask)
    for module in ("api.files", "api.describing", "codec.decoder"):
        monkeypatch.setattr(f"potr_cl.{module}.open_file", ask)
    scene, out = scene_path, tmp_path / "out.ply"
    for command in (
        ["encode", scene, "-o", tmp_path / "out.potr", *KEEP],
        ["decode", scene, "-o", out],
        ["info", scene],
        ["info", potr_path],
        ["convert", scene, out],
        ["prune", scene, "-o", out],
        ["compact", scene, "-o", out],
        ["refit", scene, "--reference", scene, "-o", out],
        ["fit", scene, "--reference", scene, "-o", out],
        ["render", scene, "--cameras", cameras_path, "-o", out],
        ["compare", scene, scene],
    ):
        asked.clear()
        for more in ([], ["--trust"]):
            fails(capsys, [*command, *more], 1, "enough")
        assert asked == [False, True], command[0]


# ------------------------------------------------------------------------------------------ where it is printed


def test_numbers_beyond_single_precision_are_no_news(small, potr_path, capsys):
    """Neither of a box nor of a scene, whose centres are far and whose colours are absurd."""
    scene = random_scene(20, 1)
    scene.means[:] *= np.float32(1e30)
    scene.sh[:, 1] = np.float32(3e38)
    ply.save("a.ply", scene)
    box = ["--box", *["-1e39"] * 3, *["1e39"] * 3]
    for words in (["decode", str(potr_path), "-o", "b.ply", *box], ["info", "a.ply"]):
        with no_warnings():
            assert cli.main(words) == 0
        assert capsys.readouterr().err == "", words
    result = program("convert", "a.ply", "b.compressed.ply", cwd=small)
    assert (result.returncode, result.stderr) == (0, "")


def test_a_terminal_of_another_alphabet(tmp_path, potr_path, monkeypatch):
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, "ascii"))
    assert cli.main(["decode", str(potr_path), "-o", str(tmp_path / "é中.ply")]) == 0
    assert b"\\xe9\\u4e2d.ply: 200 splats" in printed.getvalue()
