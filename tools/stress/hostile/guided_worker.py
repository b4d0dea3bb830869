"""The process that Atheris guides: python -m tools.stress.hostile.guided_worker FORMAT FOLDER FINDINGS [libFuzzer's].

Started by :mod:`tools.stress.guided`. Everything of the package is instrumented as it is imported, so that a changed
file that reaches new code is kept and changed further.
"""

from __future__ import annotations

import gzip
import os
import sys
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random

import atheris

with atheris.instrument_imports(include=["potr_cl"]):
    from tests.reference import file_parts
    from tools.stress.hostile import picture_files
    from tools.stress.hostile.formats import FORMATS
    from tools.stress.hostile.judge import Judge
    from tools.stress.hostile.worker import Job, keep

#: Findings of one sort that are kept.
_KEPT = 3
#: Part of the files that is changed by what knows the format; the others are changed by libFuzzer, and sealed again.
_BY_RULE = 0.3
_LONGEST = 1 << 16


def main() -> None:
    name, folder, findings, *options = sys.argv[1:]
    form = FORMATS[name]
    errors = os.dup(2)
    judge = Judge(form, Path(folder), longest=0.0)  # libFuzzer has an alarm of its own
    os.dup2(errors, 2)  # and says there how it gets on, which the judge would take for the reader's words
    job = Job(name, folder, findings)
    kept: Counter[str] = Counter()
    file = next(iter(form.good()[0]))
    number = 0

    def read(data: bytes) -> None:
        nonlocal number
        number += 1
        verdict = judge.judge(judge.put({file: data}), len(data))
        if not verdict.fine:
            sort = f"{verdict.kind} {verdict.text.strip().splitlines()[-1:]}"
            kept[sort] += 1
            if kept[sort] <= _KEPT:
                keep(Path(findings), job, number, {file: data}, verdict)

    def changed(data: bytes, most: int, seed: int) -> bytes:
        rng = Random(seed)
        if rng.random() < _BY_RULE:
            return form.changed(rng)[file][:most]
        opened, seal = _SEALS.get(name, (_as_it_is, _as_it_is))
        try:
            return seal(atheris.Mutate(opened(data), most))[:most]
        except Exception:  # what cannot be opened is changed as it is
            return bytes(atheris.Mutate(data, most))

    for good in form.good():  # what is loaded on first use counts for no file
        judge.judge(judge.put(good), 1 << 40)
    atheris.Setup([sys.argv[0], *options], read, custom_mutator=changed)
    atheris.Fuzz()


def _as_it_is(data: bytes) -> bytes:
    return data


def _inflated(data: bytes) -> bytes:
    return zlib.decompressobj(31).decompress(data, 1 << 20) if data[:2] == b"\x1f\x8b" else data


def _deflated(data: bytes) -> bytes:
    return data if data[4:5] == b"\4" else gzip.compress(data, 1, mtime=0)


def _png(data: bytes) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(picture_files.chunk(*each) for each in picture_files.chunks(data))


#: By format: what is changed in a file, and how the file is made whole again.
_SEALS: dict[str, tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]] = {
    "potr": (_as_it_is, file_parts.sealed),
    "spz": (_inflated, _deflated),
    "png": (_as_it_is, _png),
}


if __name__ == "__main__":
    main()
