"""Have readers read files that are changed towards new code: a fuzzer that coverage guides, Atheris.

    python -m tools.stress.guided [--format NAME …] [--seconds S] [--findings FOLDER] [--json FILE]

Needs the extra "fuzz". Judges as tools.stress.fuzz does; what it finds is read again by that tool's --replay. Only
formats whose files stand alone; only Python code guides, not that of libraries in C.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tools.results import Column, Results
from tools.stress.hostile.formats import FORMATS
from tools.stress.hostile.judge import LONGEST, Verdict
from tools.stress.hostile.supervisor import place, settings
from tools.stress.hostile.worker import Job, keep

#: Those whose changed files are always several, or are read by a library in C alone.
_ALONE = ["potr", "ply", "compressed.ply", "spz", "sog", "png"]
_COLUMNS = (
    Column("format"),
    Column("files", format=","),
    Column("branches at first", format=","),
    Column("branches at last", format=","),
    Column("files that led to new ones", format=","),
    Column("findings"),
    Column("time", "s", ".0f"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--format", action="append", choices=_ALONE, dest="formats", help="default: all of them")
    parser.add_argument("--seconds", type=int, default=60, metavar="S", help="for each format; default 60")
    parser.add_argument("--findings", type=Path, metavar="FOLDER", help="default: a new temporary folder")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    if importlib.util.find_spec("atheris") is None:
        parser.error("this needs Atheris: pip install atheris")
    findings = args.findings or Path(tempfile.mkdtemp(prefix="findings-"))
    results = Results(None, args.json)
    table = results.table("guided", "Files changed towards new code", *_COLUMNS)
    wrong = 0
    for name in args.formats or _ALONE:
        row = _guided(name, args.seconds, findings)
        wrong += row[4]
        table.add(name, *row)
    if wrong:
        print(f"see {findings}", file=sys.stderr)
    sys.exit(1 if wrong else 0)


def _guided(name: str, seconds: int, findings: Path) -> tuple[int, int, int, int, int, float]:
    with place() as folder, tempfile.TemporaryDirectory() as scratch:
        corpus = Path(scratch, "corpus")
        corpus.mkdir()
        for number, good in enumerate(FORMATS[name].good()):
            (corpus / f"{number}").write_bytes(next(iter(good.values())))
        artifact = Path(scratch, "ended-by")
        began = time.monotonic()
        done = subprocess.run(
            [
                sys.executable, "-m", "tools.stress.hostile.guided_worker", name, str(folder), str(findings),
                f"-max_total_time={seconds}", f"-timeout={int(LONGEST)}", "-rss_limit_mb=4096", "-max_len=65536",
                "-print_final_stats=1", "-seed=1", f"-exact_artifact_path={artifact}", str(corpus),
            ],
            env=settings(folder), cwd=folder / "cwd", capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
        elapsed = time.monotonic() - began
        said = done.stderr
        coverage = [int(each) for each in re.findall(r"cov: (\d+)", said)]
        executed = re.search(r"number_of_executed_units: +(\d+)", said)
        if not coverage or (executed is None and not artifact.exists()):
            raise RuntimeError(f"Atheris failed:\n{said[-4000:]}")
        if artifact.exists():  # a crash, or a hang
            file = next(iter(FORMATS[name].good()[0]))
            job = Job(name, str(folder), str(findings))
            keep(findings, job, 0, {file: artifact.read_bytes()}, Verdict("crash", said[-4000:], 0.0, 0))
        found = len(list(findings.glob(f"{name}-*/finding.json")))
        corpus_size = len(list(corpus.iterdir()))
        files = int(executed[1]) if executed else 0
        return files, coverage[0], coverage[-1], corpus_size, found, round(elapsed, 1)


if __name__ == "__main__":
    main()
