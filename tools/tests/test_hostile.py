"""The judge of readers sees what it is there to see; a file number stands for one file; findings can be read again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import pytest

from potr_cl.codec.sections import Coder
from potr_cl.formats.registry import SCENE_FORMATS
from tests.reference.file_parts import File, sealed
from tools.stress.bombs import BOMBS
from tools.stress.hostile.formats import FORMATS
from tools.stress.hostile.judge import Verdict
from tools.stress.hostile.potr_files import originals
from tools.stress.hostile.supervisor import attack, read_again
from tools.stress.hostile.worker import Job, changed_files, keep

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the judge looks into /proc")

ROOT = Path(__file__).parents[2]

#: Judges readers whose bodies are given by name, each in a process of its own, of a format that allows 16 MiB; prints
#: each verdict, or the exit code of what ended the process. Everything is imported once.
PROGRAM = """
import json, os, signal, subprocess, sys, time, warnings
from pathlib import Path
import numpy as np
from potr_cl.errors import DataError, PotrError
from tools.stress.hostile.formats import Format, WrongResult
from tools.stress.hostile.judge import Judge

def judged(folder, body):
    for name in ("input", "tmp", "cwd"):
        (folder / name).mkdir(parents=True)
    os.environ["TMPDIR"] = str(folder / "tmp")
    os.chdir(folder / "cwd")
    given = globals() | {"folder": folder}
    exec("def reader(path):\\n" + "\\n".join("    " + line for line in body.splitlines()), given)
    readers = [lambda path: b""]
    form = Format(list, lambda rng: {}, lambda path: readers[-1](path), 16 << 20, 0, twice=True)
    judge = Judge(form, folder, longest=1.0)
    path = judge.put({"a": b"abc"})
    for _ in range(3):
        judge.judge(path, 3)
    readers.append(given["reader"])
    verdict = judge.judge(path, 3)
    (folder / "verdict").write_text(json.dumps([verdict.kind, verdict.text]))

found = {}
for number, (name, body) in enumerate(json.loads(sys.argv[2]).items()):
    folder = Path(sys.argv[1], str(number))
    child = os.fork()
    if not child:
        judged(folder, body)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    found[name] = code or json.loads((folder / "verdict").read_text())
print(json.dumps(found))
"""


def test_every_format_of_scenes_is_attacked() -> None:
    for entry in SCENE_FORMATS:
        assert {suffix.lstrip(".") for suffix in entry.suffixes} & FORMATS.keys() or entry.names, entry.name


SEEN = {
    "read": "return b'x'",
    "refused": "raise DataError('no')",
    "exception": "raise KeyError('a')",
    "result": "raise WrongResult('a')",
    "memory": "np.ones(1 << 22).sum()",
    "memory reserved": "return np.empty(1 << 34, np.uint8) is None",
    "memory that became an error": """
try:
    np.empty(1 << 40, np.uint8)
except MemoryError:
    raise DataError("too large") from None
""",
    "message": "error = DataError('a'); error.args = ('a\\x1b[2J',); raise error",
    "message too long": "error = DataError('a'); error.args = ('a' * 5000,); raise error",
    "warning": "np.array([1.0]) / np.array([0.0])",
    "terminal": "os.write(2, b'\\x1b[2J'); return b''",
    "garbage": "return bytes(np.empty(1 << 16, np.uint8))",
    "program": "subprocess.run(['true'])",
    "name": "open('/etc/hostname', 'rb').close()",
    "name to write": "open(path.parent / 'other', 'wb').close()",
    "leftover": "(folder / 'tmp' / 'x').write_bytes(b'')",
}


#: And what ends the process: the exit codes.
ENDS = {
    # Of the processor's time, or on a busy machine of the clock's, which comes first then.
    "hang": ("while True: pass", (-27, -14)),
    "segmentation fault": ("os.kill(os.getpid(), signal.SIGSEGV)", (-11,)),
    "abort": ("os.abort()", (-6,)),
}


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    bodies = SEEN | {name: body for name, (body, _) in ENDS.items()}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path_factory.mktemp("judged")), json.dumps(bodies)],
        env={"PYTHONPATH": str(ROOT), "PYTHONMALLOC": "malloc", "PATH": "/usr/bin:/bin"},
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.parametrize("what", SEEN)
def test_the_judge_sees(what, verdicts):
    assert verdicts[what][0] == what.split()[0], verdicts[what]


@pytest.mark.parametrize("what", ENDS)
def test_what_ends_the_process(what, verdicts):
    assert verdicts[what] in ENDS[what][1]


@pytest.mark.parametrize("form", [*FORMATS, "native"])
def test_a_number_of_a_seed_is_one_file(form):
    for number in range(30):
        assert changed_files(form, 3, number) == changed_files(form, 3, number)
    assert len({str(changed_files(form, 3, number)) for number in range(30)}) > 15


def test_every_format_has_bombs():
    assert list(BOMBS) == list(FORMATS)


def test_potr_files_are_taken_apart_and_put_together():
    for data in originals():
        assert File.of(data).bytes() == sealed(data) == data
    assert {block.coder for data in originals() for block in File.of(data).blocks} == set(Coder)


def test_a_damaged_potr_file_is_sealed():
    data = bytearray(originals()[0])
    data[-1] ^= 1
    assert sealed(bytes(data))[:-1] != bytes(data)[:-1]
    assert len(sealed(bytes(data))) == len(data)
    assert sealed(b"POTR") == b"POTR"


def test_findings_are_read_again(tmp_path):
    """Good files and others, as if they were findings."""
    rng = Random(1)
    sources = []
    for number, form in enumerate(["png", "potr", "png"]):
        files = FORMATS[form].good()[0] if number < 2 else {"a.png": rng.randbytes(100)}
        job = Job(form, "", "", seed=number)
        sources.append(keep(tmp_path / "kept", job, number, files, Verdict("exception", "a", 0.0, 0)))
    results = read_again(sources, tmp_path / "again")
    assert [result["kind"] for result in results] == ["read", "read", "refused"]


def test_a_run_is_the_same_in_parts_and_by_several_processes(tmp_path):
    whole, *parts = (
        attack(Job("png", "", str(tmp_path), seed=5, first=first, count=count), processes)
        for first, count, processes in ((0, 100, 2), (0, 50, 1), (50, 50, 1))
    )
    assert whole.files == 100
    assert whole.read == sum(part.read for part in parts)
    assert whole.findings == 0
