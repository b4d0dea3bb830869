"""Have every reader read changed files, by the thousand, in processes that they may end.

    python -m tools.stress.fuzz [--format NAME …] [--count N] [--seconds S] [--seed SEED] [--processes P] [--json FILE]
    python -m tools.stress.fuzz --replay FOLDER …

Each file is a small good one with changes: of bytes, and of the parts that the format has (header fields, tables,
streams behind their coders, checksums made right again). It must be read, or refused by one line of the package's own
errors, within 5 s of processor time, and in the memory that docs/security.md promises. Anything else is a finding: a
crash, a hang, another exception, too much memory, values that are not finite, a warning, a message that could harm a
terminal, a file opened or a program started because of a name in it, results that differ between two readings, files
left behind.

File number n of a seed is always the same. Findings are kept in a folder each (--findings) with what went wrong;
--replay reads them again, and exits with 1 if any is still wrong.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from tools.results import Results
from tools.stress.hostile.formats import FORMATS
from tools.stress.hostile.supervisor import attack, read_again
from tools.stress.hostile.worker import Job
from tools.workloads import plain_parser

_MIB = 1 << 20


def fuzz_parser(description: str | None) -> argparse.ArgumentParser:
    """A command line for :func:`campaign`."""
    parser = plain_parser(description)
    parser.add_argument("--count", type=int, default=1000, metavar="N", help="files of each format; default 1000")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first one; default 0")
    parser.add_argument("--seconds", type=float, default=1e9, metavar="S", help="for each format at the most")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--processes", type=int, default=1, metavar="P", help="that read at a time; default 1")
    parser.add_argument("--findings", type=Path, metavar="FOLDER", help="default: a new temporary folder")
    parser.add_argument("--replay", type=Path, nargs="+", metavar="FOLDER", help="findings to read again")
    return parser


def campaign(
    name: str, formats: Iterable[str], args: argparse.Namespace, environment: Mapping[str, str] | None = None
) -> int:
    """Attack formats, or replay findings, in processes with some environment; 1 where something is wrong, else 0."""
    findings = args.findings or Path(tempfile.mkdtemp(prefix="findings-"))
    around = dict(environment or {})
    if args.replay:
        again = read_again(args.replay, findings, environment=around)
        for folder, told in zip(args.replay, again, strict=True):
            print(f"{folder}: {told['kind']}, {told['seconds']:.3f} s, {told['memory'] / _MIB:.1f} MiB\n{told['text']}")
        return int(any(told["kind"] not in ("read", "refused") for told in again))
    table = Results(None, args.json).table(
        name, "Changed files, what became of them, and the worst of them",
        "format; files||,; read||,; refused||,; findings||,; slowest|s of processor time|.2f; most memory|MiB|.1f; "
        "time|s|.0f",
    )  # fmt: skip
    wrong = 0
    for form in formats:
        began = time.monotonic()
        job = Job(form, "", str(findings), args.seed, args.first, args.count, args.seconds, environment=around)
        found = attack(job, args.processes)
        wrong += found.findings
        worst = round(found.slowest, 3), round(found.memory / _MIB, 3), round(time.monotonic() - began, 1)
        table.add(form, found.files, found.read, found.refused, found.findings, *worst)
    for about in sorted(findings.glob("*/finding.json")):
        told = json.loads(about.read_text())
        print(f"\n{about.parent}: {told['kind']}\n{told['text']}", file=sys.stderr)
    return int(wrong > 0)


def main() -> None:
    parser = fuzz_parser(__doc__)
    parser.add_argument("--format", action="append", choices=list(FORMATS), dest="formats", help="default: all in turn")
    args = parser.parse_args()
    sys.exit(campaign("files", args.formats or FORMATS, args))


if __name__ == "__main__":
    main()
