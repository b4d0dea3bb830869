"""Have every reader read changed files, by the thousand, in processes that they may end.

    python -m tools.stress.fuzz [--format NAME …] [--count N] [--seconds S] [--seed SEED] [--json FILE [--continue]]
    python -m tools.stress.fuzz --replay FOLDER …

Each file is a small good one with changes: of bytes, and of the parts that the format has (header fields, tables,
streams behind their coders, checksums made right again). It must be read, or refused by one line of the package's own
errors, within 5 s of processor time, and in the memory that docs/security.md promises. Anything else is a finding: a
crash, a hang, another exception, too much memory, values that are not finite, a warning, a message that could harm a
terminal, a file opened or a program started because of a name in it, results that differ between two readings, files
left behind.

File number n of a seed is always the same. Findings are kept in a folder each (--findings) with what went wrong;
--replay reads them again, and exits with 1 if any is still wrong. --continue goes on where the run that wrote the JSON
file ended, and adds to its figures.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from tools.results import Column, Results
from tools.stress.hostile.formats import FORMATS
from tools.stress.hostile.supervisor import Outcome, attack, read_again

_COLUMNS = (
    Column("format"),
    Column("files", format=","),
    Column("read", format=","),
    Column("refused", format=","),
    Column("findings", format=","),
    Column("slowest", "s of processor time", ".2f"),
    Column("most memory", "MiB", ".1f"),
    Column("time", "s", ".0f"),
)
_MIB = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--format", action="append", choices=list(FORMATS), dest="formats", help="default: all, one after another"
    )
    parser.add_argument("--count", type=int, default=1000, metavar="N", help="files of each format; default 1000")
    parser.add_argument("--seconds", type=float, default=1e9, metavar="S", help="for each format at the most")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--findings", type=Path, metavar="FOLDER", help="default: a new temporary folder")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    parser.add_argument("--continue", action="store_true", dest="go_on", help="add to the figures of --json")
    parser.add_argument("--replay", type=Path, nargs="+", metavar="FOLDER", help="findings to read again")
    args = parser.parse_args()
    findings = args.findings or Path(tempfile.mkdtemp(prefix="findings-"))
    if args.replay:
        sys.exit(_replay(args.replay, findings))
    if args.go_on and args.json is None:
        parser.error("--continue needs --json")
    before = _rows(args.json) if args.go_on else {}
    results = Results(None, args.json)
    table = results.table("files", "Changed files, what became of them, and the worst of them", *_COLUMNS)
    kept: list[str] = []
    wrong = 0
    for earlier in before.values():  # kept, should this run be cut off
        table.put(*earlier)
    for name in args.formats or FORMATS:
        row = before.get(name)
        first = int(row[1]) if row is not None else 0
        outcome = attack(name, args.seed, first, args.count, args.seconds, findings)
        kept += outcome.kept
        wrong += outcome.findings
        table.put(*_row(name, outcome, row))
    for folder in kept:
        about = json.loads(Path(folder, "finding.json").read_text())
        print(f"\n{folder}: {about['kind']}\n{about['text']}", file=sys.stderr)
    sys.exit(1 if wrong else 0)


def _row(name: str, outcome: Outcome, before: list[Any] | None) -> list[Any]:
    figures = [outcome.files, outcome.read, outcome.refused, outcome.findings]
    worst = [outcome.slowest, outcome.memory / _MIB]
    seconds = outcome.seconds
    if before is not None:
        figures = [a + b for a, b in zip(figures, before[1:5], strict=True)]
        worst = [max(a, b) for a, b in zip(worst, before[5:7], strict=True)]
        seconds += before[7]
    return [name, *figures, *(round(each, 3) for each in worst), round(seconds, 1)]


def _rows(path: Path) -> dict[str, list[Any]]:
    """The figures of an earlier run by format."""
    if not path.exists():
        return {}
    return {row[0]: row for row in json.loads(path.read_text())["files"]["rows"]}


def _replay(folders: list[Path], findings: Path) -> int:
    wrong = 0
    for result, folder in zip(read_again(folders, findings), folders, strict=True):
        memory = f"{result['memory'] / _MIB:.1f} MiB"
        print(f"{folder}: {result['kind']}, {result['seconds']:.3f} s, {memory}\n{result['text']}")
        wrong += result["kind"] not in ("read", "refused")
    return 1 if wrong else 0


if __name__ == "__main__":
    main()
