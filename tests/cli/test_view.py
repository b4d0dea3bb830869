"""The command view: it says where the page is, ends by Ctrl-C, and tells what is wrong."""

from __future__ import annotations

import http.client
import re
import signal
import subprocess
import sys

import pytest

from potr_cl.cli import main

pytestmark = pytest.mark.one_runtime


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are others there")
def test_it_serves_until_it_is_interrupted(data):
    pytest.importorskip("viser", reason="the extra view is not installed")
    command = [sys.executable, "-m", "potr_cl", "view", str(data / "plush_excerpt.ply"), "--port", "0", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout
            line = process.stdout.readline()
            found = re.search(r"http://127\.0\.0\.1:(\d+) ", line)
            assert found, line
            connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=300)
            connection.request("GET", "/")
            assert connection.getresponse().status == 200
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=300)
        finally:
            process.kill()
    assert process.returncode == 128 + signal.SIGINT
    assert "viser" not in line + said
    assert len(said.strip().splitlines()) <= 1, said


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["nowhere.ply"], 2, "nowhere.ply"),
        (["{scene}", "--truth", "."], 2, "--truth needs --cameras"),
        (["{scene}", "--port", "99999"], 2, "between 0 and 65535"),
        (["{scene}", "--host", "no.such.host"], 2, "no address of this machine"),
        (["{ladder}", "{ladder}"], 2, "the scene first"),
        (["{broken}"], 1, "ladder.json"),
    ],
)
def test_what_is_wrong_is_told_in_a_line(data, tmp_path, capsys, words, code, said):
    pytest.importorskip("viser", reason="the extra view is not installed")
    from potr_cl.formats.ladder import Ladder, Rung

    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "ladder.json").write_text("{}")
    Ladder(tmp_path / "ladder.json", "", None, "", (Rung(0.5, "a.potr", 1, 1),)).save()
    names = {"scene": data / "plush_excerpt.ply", "ladder": tmp_path, "broken": tmp_path / "broken"}
    assert main(["view", "--no-browser", "--port", "0", *(word.format(**names) for word in words)]) == code
    told = capsys.readouterr().err.strip()
    assert said in told
    assert "\n" not in told
