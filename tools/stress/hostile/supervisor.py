"""Have files read by processes that they may end (:func:`attack`, :func:`read_again`), and learn what came of them."""

from __future__ import annotations

import dataclasses
import json
import os
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
from tools.stress.hostile.worker import Job, Tally, given, keep

#: Files that a process reads before the next one begins, so that what one file leaves behind cannot hide for ever.
_A_PROCESS = 20_000
#: Processes that may end by a file before a format is given up.
_MOST_CRASHES = 20


def attack(job: Job, processes: int = 1) -> Tally:
    """What came of changed files of a format, read by so many processes at a time.

    Args:
        job: which files: number ``first`` and so on of a seed; ends after its seconds, though not all were read.
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
        ended = _run(job, folder)
        tally = Tally(**json.loads((folder / "tally").read_text()))
        if ended is not None:
            number, files, kind = tally.number, _files(folder), ended.kind
            crashes.append(number)
            if kind == "hang":  # tried alone: the machine may have been busy
                source = keep(folder / "alone", job, number, files, ended)
                kind = read_again([source], folder / "again", environment=job.environment)[0]["kind"]
            tally.add(kind)
            if kind not in ("read", "refused"):
                keep(Path(job.findings), job, number, files, ended)
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
    by_format: dict[str, list[str]] = {}
    for source in folders:
        by_format.setdefault(_about(source)["format"], []).append(str(source))
    for form, sources in by_format.items():
        job = Job(form, "", str(findings), longest=longest, environment=environment or {})
        # One process is faster; where a file ends it, each gets its own.
        with _place() as folder:
            ended = _run(dataclasses.replace(job, given=sources), folder)
        for one in sources if ended is not None else ():
            with _place() as folder:
                ended = _run(alone := dataclasses.replace(job, given=[one]), folder)
            if ended is not None:
                keep(findings, alone, 0, given(one), ended)
    return [_about(findings / source.name) for source in folders]


def _about(folder: Path) -> dict[str, Any]:
    about: dict[str, Any] = json.loads((folder / "finding.json").read_text())
    return about


def _files(folder: Path) -> Files:
    """What lies in a worker's input."""
    place = folder / "input"
    return {str(path.relative_to(place)): path.read_bytes() for path in sorted(place.rglob("*")) if path.is_file()}


def _run(job: Job, folder: Path) -> Verdict | None:
    """Have a worker do a job in a folder; what its end says of the file that it was at, if one has ended it.

    It has one thread, memory from the system's allocator, and temporary files in its folder.
    """
    settings = {
        **os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1",
        "PYTHONMALLOC": "malloc", "MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": "131072",
        "MALLOC_TRIM_THRESHOLD_": "131072", "TMPDIR": f"{folder}/tmp", "PYTHONPATH": str(ROOT),
        "PYTHONFAULTHANDLER": "1", **job.environment,
    }  # fmt: skip
    words = json.dumps({**dataclasses.asdict(job), "folder": str(folder)})
    done = subprocess.run(
        [sys.executable, "-m", "tools.stress.hostile.worker"], input=words, env=settings, cwd=folder / "cwd",
        capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    errors = folder / "stderr"
    said = (done.stderr + (errors.read_text(errors="replace") if errors.exists() else ""))[-4000:]
    if done.returncode > 0:  # whatever a reader raises is a verdict
        raise RuntimeError(f"the worker itself failed:\n{said}")
    if done.returncode in (-signal.SIGALRM, -signal.SIGPROF):
        return Verdict("hang", said, LONGEST, 0)
    if done.returncode:
        return Verdict("crash", f"{signal.Signals(-done.returncode).name}\n{said}", 0.0, 0)
    return None


@contextmanager
def _place() -> Iterator[Path]:
    """A folder in memory for a worker, which goes when the block ends."""
    shared = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="hostile-", dir=shared, ignore_cleanup_errors=True) as name:
        for part in ("input", "tmp", "cwd"):
            Path(name, part).mkdir()
        yield Path(name)
