"""Completion in real shells; those that are not installed are left out."""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from potr_cl import cli

pytest.importorskip("shtab", reason="the extra completion is not installed")


@pytest.fixture
def script(tmp_path, capsys):
    """Writes the script of a shell, and skips the test where there is no such shell."""

    def write(shell: str) -> Path:
        if shutil.which(shell) is None:
            pytest.skip(f"{shell} is not installed")
        with pytest.raises(SystemExit) as ended:
            cli.main(["--print-completion", shell])
        assert ended.value.code == 0
        path = tmp_path / f"completion.{shell}"
        path.write_text(capsys.readouterr().out)
        return path

    return write


def output(*command: str, cwd: Path) -> str:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=True, timeout=300).stdout


BASH = """
source "$1"; shift
function=$(complete -p potr-cl | sed 's/.*-F \\([^ ]*\\).*/\\1/')
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
$function potr-cl "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def in_bash(path, words, folder):
    return output("bash", "-c", BASH, "bash", str(path), "potr-cl", *words, cwd=folder).split()


def in_fish(path, words, folder):
    line = " ".join(["potr-cl", *words])
    said = output("fish", "--no-config", "-c", f"source {path}; complete -C '{line}'", cwd=folder)
    return [each.split("\t")[0] for each in said.splitlines()]


@pytest.mark.parametrize(("shell", "completed"), [("bash", in_bash), ("fish", in_fish)])
def test_words_are_completed(script, tmp_path, shell, completed):
    path = script(shell)
    (tmp_path / "scene.potr").touch()
    assert completed(path, ["enc"], tmp_path) == ["encode"]
    assert "--preset" in completed(path, ["encode", "--pres"], tmp_path)
    assert completed(path, ["encode", "--preset", ""], tmp_path) == ["best", "smallest", "fast", "paper"]
    assert completed(path, ["decode", "sce"], tmp_path) == ["scene.potr"]


def test_zsh(script, tmp_path):
    """Which completes on a terminal only."""
    pty = pytest.importorskip("pty")
    path = script("zsh")
    process, terminal = pty.fork()
    if process == 0:  # the shell
        os.chdir(tmp_path)
        os.environ.update(TERM="dumb", PS1="> ", HOME=str(tmp_path))
        os.execlp("zsh", "zsh", "-f")

    def typed(text: str, wanted: str) -> None:
        os.write(terminal, text.encode())
        written, end = "", time.monotonic() + 300
        while wanted not in written:
            ready = select.select([terminal], [], [], max(end - time.monotonic(), 0))[0]
            assert ready, written
            written += os.read(terminal, 10_000).decode("utf-8", "replace")

    try:
        typed("autoload -Uz compinit; compinit -u -d dump\r", "compinit")
        typed(f"eval \"$(cat '{path}')\"; echo rea''dy\r", "ready")
        typed("potr-cl enc\t", "encode ")
        typed("--pres\t", "--preset ")
        typed("\t\t", "smallest")
    finally:
        os.kill(process, signal.SIGKILL)
        os.close(terminal)
        os.waitpid(process, 0)


def test_without_the_library(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert cli.main(["--print-completion", "bash"]) == 2
    assert "needs the library shtab: pip install " in capsys.readouterr().err
