"""The tools that compile, attack and measure the compiled part of the decoder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest

from tools.make.native import compile_library
from tools.results import ROOT
from tools.stress import native as stress
from tools.stress.hostile.formats import WrongResult

#: Tells C of one number more than there is.
BEYOND = """
import ctypes, sys
import numpy as np
library = ctypes.CDLL(sys.argv[1])
rows = 5 + int(sys.argv[2])
points, others, out = np.zeros((5, 3), np.float32), np.zeros((1, 3)), np.zeros(rows)
where = [array.ctypes.data_as(ctypes.c_void_p) for array in (points, others, out)]
size = ctypes.c_size_t
library.potr_nearest(where[0], size(rows), where[1], size(1), where[2])
"""


def run(program, *arguments, **environment):
    return subprocess.run(
        [sys.executable, *program, *map(str, arguments)], capture_output=True, text=True, cwd=ROOT, check=False,
        env={**os.environ, **environment},
    )  # fmt: skip


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The compiled part with sanitizers."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    path = tmp_path_factory.mktemp("native") / "sanitized.so"
    compile_library(path, sanitize=True)
    return path


@pytest.mark.slow
def test_the_sanitizer_sees_one_byte_beyond(library):
    environment = stress.sanitizers(library)
    assert run(["-c", BEYOND], library, 0, **environment).returncode == 0
    beyond = run(["-c", BEYOND], library, 1, **environment)
    assert beyond.returncode != 0
    assert "heap-buffer-overflow" in beyond.stderr


@pytest.mark.slow
def test_changed_files_are_read_alike(tmp_path, library, monkeypatch):
    """By the whole command, which need not compile again."""
    report = tmp_path / "native.json"
    monkeypatch.setattr(stress, "compile_library", lambda path, **_: shutil.copyfile(library, path))
    monkeypatch.setattr(sys, "argv", ["native", "--seed", "8", "--count", "15", "--json", str(report)])
    with pytest.raises(SystemExit) as ended:
        stress.main()
    assert ended.value.code == 0
    ((_, files, read, refused, findings, *_),) = json.loads(report.read_text())["native"]["rows"]
    assert (files, findings) == (15, 0)
    assert read + refused == files
    assert read > 0 < refused


def test_a_difference_is_a_finding():
    stress._same([b"a"], [b"a"], "NumPy")
    with pytest.raises(WrongResult, match="native: reads it; NumPy: no"):
        stress._same([b"a"], "no", "NumPy")
