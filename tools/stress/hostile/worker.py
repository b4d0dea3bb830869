"""The process that reads changed files one after another: python -m tools.stress.hostile.worker, a job on its input.

It may be ended by any file: :mod:`tools.stress.hostile.supervisor` starts it, learns from the :class:`Tally` in its
folder how far it came, and finds the file that ended it in the folder ``input``.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import sys
import time
from collections import Counter
from pathlib import Path
from random import Random

from tools.stress.hostile.changes import Files
from tools.stress.hostile.formats import FORMATS, Format
from tools.stress.hostile.judge import LONGEST, Judge, Verdict

#: Findings of one sort that are kept.
_KEPT = 3


@dataclasses.dataclass
class Job:
    """What a worker is to do: files that it makes itself, or given ones.

    Attributes:
        form: name of the format; or of the module of tools.stress whose FORM it is.
        folder: with the folders input, tmp and cwd.
        findings: folder to keep what is wrong in.
        seed, first, count: of the files to make: number ``first`` to ``first + count - 1`` of a seed.
        seconds: to end after.
        given: folders, each with files to read and ``finding.json``; instead of made ones.
        longest: seconds that a file may take.
        environment: variables of the worker.
    """

    form: str
    folder: str
    findings: str
    seed: int = 0
    first: int = 0
    count: int = 0
    seconds: float = 1e9
    given: list[str] = dataclasses.field(default_factory=list)
    longest: float = LONGEST
    environment: dict[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Tally:
    """How far a worker came: the number of the file at work, what became of those before, and the worst of them."""

    number: int = 0
    read: int = 0
    refused: int = 0
    findings: int = 0
    memory: int = 0
    slowest: float = 0.0

    @property
    def files(self) -> int:
        """Those that something became of."""
        return self.read + self.refused + self.findings

    def add(self, kind: str, seconds: float = 0.0, memory: int = 0) -> None:
        """Count a file."""
        self.number += 1
        self.read += kind == "read"
        self.refused += kind == "refused"
        self.findings += kind not in ("read", "refused")
        self.slowest, self.memory = max(self.slowest, seconds), max(self.memory, memory)

    def take(self, other: Tally) -> None:
        """Count another's files, too."""
        self.number, self.read, self.refused = other.number, self.read + other.read, self.refused + other.refused
        self.findings += other.findings
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)


def main() -> None:
    work(Job(**json.load(sys.stdin)))


def work(job: Job) -> None:
    """Read file after file."""
    form, folder = format_of(job.form), Path(job.folder)
    shared = os.open(folder / "tally", os.O_WRONLY | os.O_CREAT, 0o600)
    tally = Tally(number=job.first)
    judge = Judge(form, folder, job.longest)
    for again in (False, True):  # what is loaded on first use counts for no file
        for files in form.good():
            verdict = judge.judge(judge.put(files), 1 << 40)
            if again and verdict.kind != "read":
                raise RuntimeError(f"a good file is not read: {verdict}")
    kept: Counter[str] = Counter()
    end, stop = time.monotonic() + job.seconds, job.first + (len(job.given) or job.count)
    while tally.number < stop and time.monotonic() < end:
        number = tally.number
        files = given(job.given[number - job.first]) if job.given else changed_files(job.form, job.seed, number)
        place = judge.put(files)
        _tell(shared, tally)
        verdict = judge.judge(place, sum(map(len, files.values())))
        tally.add(verdict.kind, verdict.seconds, verdict.memory)
        sort = f"{verdict.kind} {verdict.text.strip().splitlines()[-1][:60] if verdict.text.strip() else ''}"
        kept[sort] += not verdict.fine
        if job.given or (not verdict.fine and kept[sort] <= _KEPT):
            keep(Path(job.findings), job, number, files, verdict)
    _tell(shared, tally)


def _tell(shared: int, tally: Tally) -> None:
    os.pwrite(shared, json.dumps(dataclasses.asdict(tally)).ljust(200).encode(), 0)


def format_of(name: str) -> Format:
    """That of a name, as of :attr:`Job.form`."""
    found: Format = FORMATS.get(name) or importlib.import_module(f"tools.stress.{name}").FORM
    return found


def changed_files(form: str, seed: int, number: int) -> Files:
    """The changed files of a seed, each for itself: number 7 is the same whether or not 6 was made."""
    return format_of(form).changed(Random(f"{seed}/{form}/{number}"))


def keep(findings: Path, job: Job, number: int, files: Files, verdict: Verdict) -> Path:
    """Keep files and what came of them, so that they can be read again; returns their folder."""
    name = Path(job.given[number - job.first]).name if job.given else f"{job.form}-{job.seed}-{number}"
    folder = findings / name
    for inner, content in files.items():
        (folder / inner).parent.mkdir(parents=True, exist_ok=True)
        (folder / inner).write_bytes(content)
    about = {"format": job.form, "seed": job.seed, "number": number, "names": list(files)}
    (folder / "finding.json").write_text(json.dumps({**about, **dataclasses.asdict(verdict)}, indent=1))
    return folder


def given(folder: str) -> Files:
    """The files of a folder as :func:`keep` leaves it."""
    names = json.loads(Path(folder, "finding.json").read_text())["names"]
    return {name: Path(folder, name).read_bytes() for name in names}


if __name__ == "__main__":
    main()
