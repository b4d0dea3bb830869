"""The process that reads changed files one after another: python -m tools.stress.hostile.worker, a job on its input.

It may be ended by any file: :mod:`tools.stress.hostile.supervisor` starts it, learns from the :class:`Tally` in its
folder how far it came, and finds the file that ended it in the folder ``input``.
"""

from __future__ import annotations

import dataclasses
import json
import mmap
import struct
import sys
import time
from collections import Counter
from pathlib import Path
from random import Random

from tools.stress.hostile.changes import Files
from tools.stress.hostile.formats import FORMATS
from tools.stress.hostile.judge import LONGEST, Judge, Verdict

#: Findings of one sort that are kept.
_KEPT = 3
_FIELDS = struct.Struct("<6QdQ")


@dataclasses.dataclass
class Job:
    """What a worker is to do: files that it makes itself, or given ones.

    Attributes:
        form: name of the format.
        folder: with the folders input, tmp and cwd.
        findings: folder to keep what is wrong in.
        seed, first, count: of the files to make: number ``first`` to ``first + count - 1`` of a seed.
        seconds: to end after.
        given: folders, each with files to read and ``finding.json``; instead of made ones.
        longest: seconds that a file may take.
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


@dataclasses.dataclass
class Tally:
    """How far a worker came. ``number`` is that of the file at work."""

    number: int = 0
    read: int = 0
    refused: int = 0
    findings: int = 0
    bytes: int = 0
    memory: int = 0
    slowest: float = 0.0
    done: int = 0

    @staticmethod
    def of(path: Path) -> Tally:
        data = path.read_bytes() if path.exists() else b""
        return Tally(*_FIELDS.unpack(data)) if len(data) == _FIELDS.size else Tally()

    def pack_into(self, buffer: mmap.mmap) -> None:
        _FIELDS.pack_into(
            buffer, 0, self.number, self.read, self.refused, self.findings, self.bytes, self.memory, self.slowest,
            self.done,
        )  # fmt: skip


def main() -> None:
    work(Job(**json.load(sys.stdin)))


def work(job: Job) -> None:
    """Read file after file."""
    form, folder = FORMATS[job.form], Path(job.folder)
    path = folder / "tally"
    path.write_bytes(bytes(_FIELDS.size))
    tally = Tally(number=job.first)
    judge = Judge(form, folder, job.longest)
    for again in (False, True):  # what is loaded on first use counts for no file
        for files in form.good():
            verdict = judge.judge(judge.put(files), 1 << 40)
            if again and verdict.kind != "read":
                raise RuntimeError(f"a good file is not read: {verdict}")
    kept: Counter[str] = Counter()
    end = time.monotonic() + job.seconds
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as shared:
        cases = given(job.given) if job.given else None
        while tally.number < job.first + (len(job.given) or job.count) and time.monotonic() < end:
            if cases is not None:
                files = cases[tally.number - job.first]
            else:
                files = changed_files(job.form, job.seed, tally.number)
            size = sum(map(len, files.values()))
            place = judge.put(files)
            tally.bytes += size
            tally.pack_into(shared)
            verdict = judge.judge(place, size)
            tally.memory = max(tally.memory, verdict.memory)
            tally.slowest = max(tally.slowest, verdict.seconds)
            tally.read += verdict.kind == "read"
            tally.refused += verdict.kind == "refused"
            if not verdict.fine or job.given:
                tally.findings += not verdict.fine
                sort = f"{verdict.kind} {verdict.text.strip().splitlines()[-1][:60] if verdict.text.strip() else ''}"
                kept[sort] += 1
                if kept[sort] <= _KEPT or job.given:
                    keep(Path(job.findings), job, tally.number, files, verdict)
            tally.number += 1
            tally.pack_into(shared)
        tally.done = 1
        tally.pack_into(shared)


def changed_files(form: str, seed: int, number: int) -> Files:
    """The changed files of a seed, each for itself: number 7 is the same whether or not 6 was made."""
    return FORMATS[form].changed(Random(f"{seed}/{form}/{number}"))


def keep(findings: Path, job: Job, number: int, files: Files, verdict: Verdict) -> Path:
    """Keep files and what came of them, so that they can be read again; returns their folder."""
    name = Path(job.given[number - job.first]).name if job.given else f"{job.form}-{job.seed}-{number}"
    folder = findings / name
    for inner, content in files.items():
        (folder / inner).parent.mkdir(parents=True, exist_ok=True)
        (folder / inner).write_bytes(content)
    about = {"format": job.form, "seed": job.seed, "number": number, "first": next(iter(files)), "names": list(files)}
    (folder / "finding.json").write_text(json.dumps({**about, **dataclasses.asdict(verdict)}, indent=1))
    return folder


def given(folders: list[str]) -> list[Files]:
    """The files of folders as :func:`keep` leaves them."""
    found = []
    for folder in map(Path, folders):
        names = json.loads((folder / "finding.json").read_text())["names"]
        found.append({name: (folder / name).read_bytes() for name in names})
    return found


if __name__ == "__main__":
    main()
