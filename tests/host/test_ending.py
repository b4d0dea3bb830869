"""The end of a process: at once, but with everything done that was left to the end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(program: str, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", f"import sys\nfrom potr_cl.host.process import end_at_once\n{program}"]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": ROOT} | options
    return subprocess.run(command, text=True, check=False, timeout=300, **options)


@pytest.mark.parametrize("code", [0, 130])
def test_the_process_ends_with_its_code_and_nothing_is_lost(code):
    done = run(
        "import atexit\natexit.register(lambda: print('at the end', flush=True))\n"
        f"sys.stdout.write('x' * 100000 + '\\n')\nsys.stderr.write('told')\nend_at_once({code})\nprint('never')"
    )
    assert (done.returncode, done.stderr) == (code, "told")
    assert done.stdout == "x" * 100000 + "\nat the end\n"


def test_work_that_goes_on_is_waited_for():
    done = run(
        "import threading, time\n"
        "threading.Thread(target=lambda: (time.sleep(0.3), print('done'))).start()\n"
        "end_at_once(0)\nprint('an ordinary end')"
    )
    assert (done.returncode, done.stdout) == (0, "an ordinary end\ndone\n")


def test_a_profiler_is_not_cheated_of_its_result(tmp_path):
    program = tmp_path / "program.py"
    program.write_text("from potr_cl.host.process import end_at_once\nend_at_once(0)\nprint('an ordinary end')\n")
    command = [sys.executable, "-m", "cProfile", "-o", str(tmp_path / "profile"), str(program)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300, env=environment)
    assert done.stdout == "an ordinary end\n"
    assert (tmp_path / "profile").stat().st_size > 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device here")
def test_what_cannot_be_written_is_told_by_an_ordinary_end():
    with open("/dev/full", "w") as full:
        done = run("print('x')\nend_at_once(0)", stdout=full)
    assert done.returncode != 0
    assert "No space left" in done.stderr
