"""Have files read by processes that they may end (:func:`attack`, :func:`read_again`), and learn what came of them."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tools.results import ROOT
from tools.stress.hostile.changes import Files
from tools.stress.hostile.judge import LONGEST, Verdict
from tools.stress.hostile.worker import Job, Tally, keep

#: Files that a process reads before the next one begins, so that what one file leaves behind cannot hide for ever.
_A_PROCESS = 20_000
#: Processes that may end by a file before a format is given up.
_MOST_CRASHES = 20


@dataclasses.dataclass
class Outcome:
    """What came of many files of one format.

    Attributes:
        files: that were read or refused, or are findings.
        kinds: findings, how many of each kind.
        kept: folders with some of them.
        memory: bytes that a single file took at most. slowest: seconds that one took at most.
        seconds: all together, starts of processes left out.
    """

    files: int = 0
    read: int = 0
    refused: int = 0
    findings: int = 0
    bytes: int = 0
    memory: int = 0
    slowest: float = 0.0
    seconds: float = 0.0
    kept: list[str] = dataclasses.field(default_factory=list)


def attack(form: str, seed: int, first: int, count: int, seconds: float, findings: Path) -> Outcome:
    """Have changed files of a format read.

    Args:
        seed, first, count: which: number ``first`` and so on of a seed.
        seconds: to end after, though not all were read.
        findings: folder for those of which something is wrong.
    """
    total = Outcome()
    number, stop, end, crashes = first, first + count, time.monotonic() + seconds, 0
    while number < stop and time.monotonic() < end and crashes < _MOST_CRASHES:
        with place() as folder:
            job = Job(
                form, str(folder), str(findings), seed, number, min(_A_PROCESS, stop - number), end - time.monotonic()
            )
            began = time.monotonic()
            code, said = run(job)
            tally = Tally.of(folder / "tally")
            total.seconds += time.monotonic() - began
            if code != 0:
                crashes += 1
                verdict = _ending(code, said)
                kind = _alone(job, _files(folder), tally.number) if verdict.kind == "hang" else verdict.kind
                tally.read += kind == "read"
                tally.refused += kind == "refused"
                if kind not in ("read", "refused"):
                    tally.findings += 1
                    keep(findings, job, tally.number, _files(folder), verdict)
                tally.number += 1
        _add(total, tally, tally.number - number)
        number = tally.number
    total.kept = sorted(str(each.parent) for each in findings.glob(f"{form}-{seed}-*/finding.json"))
    return total


def read_again(folders: list[Path], findings: Path, longest: float = LONGEST) -> list[dict[str, Any]]:
    """Read files that were kept, as :func:`tools.stress.hostile.worker.keep` leaves them.

    Args:
        folders: of the files, no two of one name.
        findings: folder to keep what comes of them in, under the same names.

    Returns:
        For each what finding.json says of it then.
    """
    by_format: dict[str, list[Path]] = {}
    for source in folders:
        by_format.setdefault(_about(source)["format"], []).append(source)
    for form, sources in by_format.items():
        # One process is faster; where a file ends it, each gets its own.
        if _read_given(form, sources, findings, longest)[0] != 0:
            for source in sources:
                code, said, files = _read_given(form, [source], findings, longest)
                if code != 0:
                    keep(findings, Job(form, "", "", given=[str(source)]), 0, files, _ending(code, said))
    return [_about(findings / source.name) for source in folders]


def _about(folder: Path) -> dict[str, Any]:
    about: dict[str, Any] = json.loads((folder / "finding.json").read_text())
    return about


def _read_given(form: str, sources: list[Path], findings: Path, longest: float) -> tuple[int, str, Files]:
    """A worker's exit code, what it said, and the files that it was at."""
    with place() as folder:
        job = Job(form, str(folder), str(findings), given=[str(source) for source in sources], longest=longest)
        code, said = run(job)
        return code, said, _files(folder, _about(sources[0])["names"] if sources[1:] == [] else None)


def run(job: Job) -> tuple[int, str]:
    """Start a worker and wait; its exit code (below 0: minus a signal's number) and the end of what it said."""
    done = subprocess.run(
        [sys.executable, "-m", "tools.stress.hostile.worker"],
        input=json.dumps(dataclasses.asdict(job)), env=settings(Path(job.folder)), cwd=f"{job.folder}/cwd",
        capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    errors = Path(job.folder, "stderr")
    told = errors.read_text(errors="replace") if errors.exists() else ""
    said = (done.stderr + told)[-4000:]
    if done.returncode > 0:  # whatever a reader raises is a verdict
        raise RuntimeError(f"the worker itself failed:\n{said}")
    return done.returncode, said


def settings(folder: Path) -> dict[str, str]:
    """The environment of a worker: one thread, memory from the system's allocator, temporary files in its folder."""
    return {
        **os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1",
        "PYTHONMALLOC": "malloc", "MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": "131072",
        "MALLOC_TRIM_THRESHOLD_": "131072", "TMPDIR": f"{folder}/tmp", "PYTHONPATH": str(ROOT),
        "PYTHONFAULTHANDLER": "1",
    }  # fmt: skip


class place:
    """A folder in memory for a worker, which goes when the block ends."""

    def __enter__(self) -> Path:
        parent = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        self._folder = Path(tempfile.mkdtemp(prefix="hostile-", dir=parent))
        for name in ("input", "tmp", "cwd"):
            (self._folder / name).mkdir()
        return self._folder

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


def _ending(code: int, said: str) -> Verdict:
    """What a worker's end says of the file that it was at."""
    if code in (-signal.SIGALRM, -signal.SIGPROF):
        return Verdict("hang", said, LONGEST, 0)
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return Verdict("crash", f"{name}\n{said}", 0.0, 0)


def _alone(job: Job, files: Files, number: int) -> str:
    """What becomes of a file that seemed to hang when it is tried alone: the machine may have been busy."""
    with tempfile.TemporaryDirectory() as scratch:
        source = keep(Path(scratch), job, number, files, Verdict("hang", "", 0.0, 0))
        return str(read_again([source], Path(scratch, "again"))[0]["kind"])


def _files(folder: Path, names: list[str] | None = None) -> Files:
    """What lies in a worker's input."""
    place = folder / "input"
    names = names or [str(path.relative_to(place)) for path in sorted(place.rglob("*")) if path.is_file()]
    return {name: (place / name).read_bytes() for name in names if (place / name).is_file()}


def _add(total: Outcome, tally: Tally, files: int) -> None:
    total.files += files
    total.read += tally.read
    total.refused += tally.refused
    total.findings += tally.findings
    total.bytes += tally.bytes
    total.memory = max(total.memory, tally.memory)
    total.slowest = max(total.slowest, tally.slowest)
