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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
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


def attack(job: Job, processes: int = 1) -> Tally:
    """Have changed files of a format read, by so many processes at a time.

    Args:
        job: which files: number ``first`` and so on of a seed; ends after its seconds, though not all were read.

    Returns:
        What came of them.
    """
    share = max(1, min(_A_PROCESS, -(-job.count // processes)))
    shares, end = iter(range(job.first, job.first + job.count, share)), time.monotonic() + job.seconds
    crashes: list[int] = []

    def some() -> Tally:
        total = Tally()
        for first in shares:
            stop = min(first + share, job.first + job.count)
            while first < stop and time.monotonic() < end and len(crashes) < _MOST_CRASHES:
                own = dataclasses.replace(job, first=first, count=stop - first, seconds=end - time.monotonic())
                tally = _attack(own, crashes)
                total.take(tally)
                first = tally.number
        return total

    total = Tally()
    with ThreadPoolExecutor(processes) as pool:
        for found in [pool.submit(some) for _ in range(processes)]:
            total.take(found.result())
    return total


def _attack(job: Job, crashes: list[int]) -> Tally:
    """By one process, up to the file that ends it, whose number is kept."""
    with _place() as folder:
        code, said = _run(job := dataclasses.replace(job, folder=str(folder)))
        tally = Tally(**json.loads((folder / "tally").read_text()))
        if code != 0:
            number, files, verdict = tally.number, _files(folder), _ending(code, said)
            crashes.append(number)
            kind = _alone(job, files, number) if verdict.kind == "hang" else verdict.kind
            tally.add(kind)
            if kind not in ("read", "refused"):
                keep(Path(job.findings), job, number, files, verdict)
    return tally


def read_again(
    folders: list[Path], findings: Path, longest: float = LONGEST, environment: dict[str, str] | None = None
) -> list[dict[str, Any]]:
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
        job = Job(form, "", str(findings), longest=longest, environment=environment or {})
        # One process is faster; where a file ends it, each gets its own.
        if _read_given(job, sources)[0] != 0:
            for source in sources:
                code, said, files = _read_given(job, [source])
                if code != 0:
                    keep(findings, dataclasses.replace(job, given=[str(source)]), 0, files, _ending(code, said))
    return [_about(findings / source.name) for source in folders]


def _about(folder: Path) -> dict[str, Any]:
    about: dict[str, Any] = json.loads((folder / "finding.json").read_text())
    return about


def _read_given(job: Job, sources: list[Path]) -> tuple[int, str, Files]:
    """A worker's exit code, what it said, and the files that it was at."""
    with _place() as folder:
        code, said = _run(dataclasses.replace(job, folder=str(folder), given=list(map(str, sources))))
        return code, said, _files(folder, _about(sources[0])["names"] if sources[1:] == [] else None)


def _run(job: Job) -> tuple[int, str]:
    """Start a worker and wait; its exit code (below 0: minus a signal's number) and the end of what it said.

    It has one thread, memory from the system's allocator, and temporary files in its folder.
    """
    settings = {
        **os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1",
        "PYTHONMALLOC": "malloc", "MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": "131072",
        "MALLOC_TRIM_THRESHOLD_": "131072", "TMPDIR": f"{job.folder}/tmp", "PYTHONPATH": str(ROOT),
        "PYTHONFAULTHANDLER": "1", **job.environment,
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "tools.stress.hostile.worker"], input=json.dumps(dataclasses.asdict(job)), env=settings,
        cwd=f"{job.folder}/cwd", capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    errors = Path(job.folder, "stderr")
    said = (done.stderr + (errors.read_text(errors="replace") if errors.exists() else ""))[-4000:]
    if done.returncode > 0:  # whatever a reader raises is a verdict
        raise RuntimeError(f"the worker itself failed:\n{said}")
    return done.returncode, said


@contextmanager
def _place() -> Iterator[Path]:
    """A folder in memory for a worker, which goes when the block ends."""
    folder = Path(tempfile.mkdtemp(prefix="hostile-", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    for name in ("input", "tmp", "cwd"):
        (folder / name).mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _ending(code: int, said: str) -> Verdict:
    """What a worker's end says of the file that it was at."""
    if code in (-signal.SIGALRM, -signal.SIGPROF):
        return Verdict("hang", said, LONGEST, 0)
    return Verdict("crash", f"{signal.Signals(-code).name}\n{said}", 0.0, 0)


def _alone(job: Job, files: Files, number: int) -> str:
    """What becomes of a file that seemed to hang when it is tried alone: the machine may have been busy."""
    with tempfile.TemporaryDirectory() as scratch:
        source = keep(Path(scratch), job, number, files, Verdict("hang", "", 0.0, 0))
        return str(read_again([source], Path(scratch, "again"), environment=job.environment)[0]["kind"])


def _files(folder: Path, names: list[str] | None = None) -> Files:
    """What lies in a worker's input."""
    place = folder / "input"
    names = names or [str(path.relative_to(place)) for path in sorted(place.rglob("*")) if path.is_file()]
    return {name: (place / name).read_bytes() for name in names if (place / name).is_file()}
