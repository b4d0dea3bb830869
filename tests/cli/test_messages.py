"""What the command line says: wrong calls in one line, progress in logs and on terminals, how loud, what colours."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from potr_cl import cli
from potr_cl.api import inputs
from potr_cl.cli import command_parser
from potr_cl.cli.progress import Progress
from potr_cl.cli.terminal import note, speak
from potr_cl.formats.scenes import ply
from tests.cli.calls import ROOT, cameras_json
from tests.reference.scenes import random_scene

COMMANDS = next(
    action.choices for action in command_parser()._actions if isinstance(action, argparse._SubParsersAction)
)


@pytest.fixture(autouse=True)
def _normal_again():
    yield
    speak("normal")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A small scene, and its cameras."""
    folder = tmp_path_factory.mktemp("scene")
    ply.save(folder / "scene.ply", random_scene(200, 2))
    return folder / "scene.ply", cameras_json(folder / "cameras.json")


@pytest.fixture
def encode(scene, tmp_path):
    """A short encode."""
    return ["encode", scene[0], "--cameras", scene[1], "-o", tmp_path / "a.potr", "--iterations", "2", "--refit", "1"]


def called(capsys, *arguments):
    code = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


# Wrong calls


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (["convert", "a.ply", "x.spz", "--antialiased", "perhaps"], "perhaps"),
        (["convert", "a.ply", "x.spz", "--spz-version", "1"], "--spz-version"),
        ([], "a command is missing: encode, prune, "),
        (["encod", "a.ply"], "unknown command 'encod': did you mean encode?"),
        (["a.ply"], "to compress a scene: potr-cl encode a.ply -o OUT.potr"),
        (["encode"], '.html, lod-meta.json or tileset.json, a folder, or "-" for standard output) is missing (see'),
        (["encode", "a.ply", "--outptu", "b"], "unknown option '--outptu': did you mean --output OUT.potr?"),
        (["encode", "a.ply", "--camras=b", "-o", "c"], "did you mean --cameras PATH?"),
        (["encode", "a.ply", "--bananas", "-o", "c"], "unknown option '--bananas'"),
        (["encode", "a.ply", "-o", "c", "-z"], "unknown option '-z'"),
        (["encode", "a.ply", "-o"], "-o/--output needs a value: OUT.potr (.potr, .spz, "),
        (["encode", "a.ply", "-o", "c", "-q", "x"], "-q/--quality is 'x', it must be a number"),
        (
            ["encode", "a.ply", "-o", "c", "--preset", "bset"],
            "must be best, smallest, fast or paper; did you mean best?",
        ),
        (["encode", "a.ply", "-o", "c", "--max-size", "1M", "-q", "0.2"], "not allowed with argument"),
        (["info", "a.potr", "b.ply"], "'b.ply' is one argument too many"),
        (["info", "a\x1b[31m.ply", "b\x1b[31m.ply"], "'b\\x1b[31m.ply' is one argument too many"),
        (["--print-completion", "bahs"], "did you mean bash?"),
    ],
)
def test_a_wrong_call_is_told_in_one_line(call, said, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(call)
    assert ended.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert said in captured.err
    command = f" {call[0]}" if call and call[0] in COMMANDS else ""
    assert f"(see potr-cl{command} --help)" in captured.err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_has_help_and_every_command_can_be_quiet(name):
    command = COMMANDS[name]
    assert [action.dest for action in command._actions if not action.help] == []
    flags = {flag for action in command._actions for flag in action.option_strings}
    assert {"--quiet", "--verbose"} <= flags


# How much is said


def test_how_much_is_said(encode, capsys, monkeypatch):
    code, _, err = called(capsys, *encode)
    cameras, device, *_ = err.splitlines()
    assert code == 0
    assert cameras.endswith("the cameras were taken as they are")
    assert re.fullmatch(r"on '.+' \(.+\), kernels for [CG]PUs: 200 splats, 6 views of 64 x 64", device)
    assert not re.search("driver: |reading|[\x1b\r]", err)
    monkeypatch.setattr(inputs, "_LONG_TO_READ", 10_000)
    _, _, verbose = called(capsys, *encode, "--verbose")
    assert re.fullmatch(r"reading .*scene\.ply, 0\.0 GB …", verbose.splitlines()[0])
    assert "driver: " in verbose


def test_quiet_says_nothing_but_what_was_asked_for(encode, capsys):
    assert called(capsys, *encode, "--quiet") == (0, "", "")
    for call, said in (("info", "splats"), ("encode", "{")):
        words = ["info", encode[5]] if call == "info" else [*encode, "--json"]
        code, out, err = called(capsys, *words, "--quiet")
        assert (code, err) == (0, "")
        assert said in out
    code, out, err = called(capsys, "decode", "nothing.potr", "-o", "a.ply", "--quiet")
    assert (code, out, err.count("\n")) == (2, "", 1)


def test_a_long_run_says_what_it_will_take(encode, capsys, monkeypatch):
    monkeypatch.setattr("potr_cl.pipeline.forecast._LONG", 1000)
    _, _, err = called(capsys, *encode)
    assert re.fullmatch(r"about [\d.]+ [MG]B of memory( of the device)?", err.splitlines()[2])


def test_a_long_stage_says_how_long_it_will_go_on(capsys, monkeypatch):
    monkeypatch.setattr("potr_cl.cli.progress.time", SimpleNamespace(perf_counter=iter([0, 4, 5, 10]).__next__))
    progress = Progress()
    for stage, done in (("a", 0), ("a", 0.01), ("a", 0.1), ("a", 0.2), ("b", 0), ("b", 0.5)):
        progress(stage, done)
    assert capsys.readouterr().err.splitlines() == ["a …", "a: about 36 s left", "b …"]


# Progress


def test_a_stage_is_told_once_in_a_log(encode, capsys):
    _, _, err = called(capsys, *encode, "--max-size", "4k")
    lines = err.splitlines()
    for stage in ("prepare views", "prune", "refit", "entropy coding", "evaluate"):
        assert lines.count(f"{stage} …") == 1, err
        assert sum(line.startswith(f"{stage}: ") for line in lines) == 1, err


def test_a_stage_that_goes_on_is_told_once(capsys):
    with Progress() as progress:
        for stage, done in (
            ("a", 0), ("a", 0.5), ("b", 0), ("b", 1), ("a", 0.7), ("a", 1), ("a", 0.2), ("a", 1), ("c", 0), ("c", 0.5)
        ):  # fmt: skip
            progress(stage, done)
    lines = [re.sub(r"\d+\.\d", "T", line) for line in capsys.readouterr().err.splitlines()]
    assert lines == ["a …", "b …", "b: T s", "a: T s", "c …"]


class Terminal(io.StringIO):
    """Keeps what a terminal would show."""

    def isatty(self) -> bool:
        return True

    def shows(self, pattern: str) -> None:
        """Wait until something is shown. A busy machine may leave out a second."""
        end = time.monotonic() + 60
        while not re.search(pattern, self.getvalue()):
            assert time.monotonic() < end, f"not shown: {pattern}, but {self.getvalue()}"
            time.sleep(0.02)


def test_the_clock_ticks_whatever_the_work_does(monkeypatch):
    class Soon(threading.Event):
        """Of a clock by which seconds pass faster."""

        def wait(self, timeout=None):
            return super().wait(timeout / 50)

    now = time.time
    monkeypatch.setattr("tqdm.std.time", lambda: 50 * now())
    faster = SimpleNamespace(Event=Soon, Thread=threading.Thread, RLock=threading.RLock)
    monkeypatch.setattr("potr_cl.cli.progress.threading", faster)
    with contextlib.redirect_stderr(Terminal()) as terminal, Progress() as progress:
        terminal.shows(r"preparing: 00:\d[1-9] elapsed")
        progress("fit", 0.0)
        terminal.shows(r"fit:   0%.* 00:\d[1-9] elapsed, \? left")
        progress("fit", 1.0)
        note("a line")
        terminal.shows("a line\n")


def test_what_is_interrupted_is_not_shown_as_done():
    def interrupted() -> None:
        with Progress() as progress:
            progress("refit", 0.25)
            progress("refit", 1.0)  # what frees what a stage holds says so, whatever has ended it
            raise KeyboardInterrupt

    with contextlib.redirect_stderr(Terminal()) as terminal:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert " 25%" in terminal.getvalue()
        assert "refit: 0.0 s" not in terminal.getvalue()
        with Progress() as progress:
            progress("fit", 0.25)
            progress("fit", 1.0)
            progress("fit", 0.99)  # a fit that was interrupted is tried against none
        assert "fit: 00:00 elapsed" in terminal.getvalue()
        assert not re.search(r" 99%|100%", terminal.getvalue())


# Terminals


@pytest.mark.parametrize(
    ("variables", "start"),
    [
        ({"TERM": "xterm"}, "\x1b[1;31mpotr-cl:\x1b[0m "),
        ({"TERM": "xterm", "NO_COLOR": "1"}, "potr-cl: "),
        ({"TERM": "dumb"}, "potr-cl: "),
    ],
)
def test_colours_are_for_terminals_that_want_them(variables, start, monkeypatch, capsys):
    monkeypatch.delenv("NO_COLOR", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    wrong = ["decode", "nothing.potr", "-o", "a.ply"]
    with contextlib.redirect_stderr(Terminal()) as terminal:
        assert cli.main(wrong) == 2
    assert terminal.getvalue().startswith(start)
    assert "\x1b" not in terminal.getvalue().removeprefix(start)
    assert "\x1b" not in called(capsys, *wrong)[2]


def test_help_has_no_escapes_in_any_version_of_python(monkeypatch, capsys):
    """Newer ones colour it where they think that it goes to a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    with pytest.raises(SystemExit):
        cli.main(["encode", "--help"])
    assert "x1b" not in capsys.readouterr().out


def test_a_terminal_gets_a_bar(encode):
    with contextlib.redirect_stderr(Terminal()) as terminal:
        assert cli.main([str(word) for word in encode]) == 0
    assert "elapsed" in terminal.getvalue()
    assert "\r" in terminal.getvalue()
    assert "…" not in terminal.getvalue()


def test_a_warning_has_its_colour_and_is_said_even_if_quiet(capsys):
    speak("quiet")
    note("news")
    note("warning: too few views", "warning")
    assert capsys.readouterr().err == "warning: too few views\n"


# The end


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_an_encode_that_is_told_to_end_leaves_nothing(encode, tmp_path):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    target = tmp_path / "a.potr"
    target.write_bytes(b"old")
    # The fit goes on for seconds; all other stages of so small a scene are over before a signal comes.
    long = [*map(str, encode), "--fit", "100000", "--report", str(tmp_path / "page.html")]
    process = subprocess.Popen(
        [sys.executable, "-m", "potr_cl", *long], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"TMPDIR": str(temporary)},
    )  # fmt: skip
    assert process.stderr is not None
    while (line := process.stderr.readline()) != "fit …\n":
        assert line
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 143
    assert "potr-cl: terminated; no file is left half written\n" in err
    assert "Traceback" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.potr", "temporary"]
    assert target.read_bytes() == b"old"
    # pyopencl leaves the source of a program whose build a signal has ended.
    assert [path.name for path in temporary.iterdir() if path.suffix != ".cl"] == []
