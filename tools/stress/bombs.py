"""Have every reader read files that unpack to far more than they are, or claim to, each in a process with a limit.

    python -m tools.stress.bombs [--format NAME …] [--json FILE]

A bomb must be refused, or read within 5 s of processor time and the memory that docs/security.md promises. Exits with 1
if one is not.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tools.results import Results
from tools.stress.hostile.bomb_files import BOMBS
from tools.stress.hostile.judge import Verdict
from tools.stress.hostile.supervisor import read_again
from tools.stress.hostile.worker import Job, keep
from tools.workloads import plain_parser

_MIB = 1 << 20


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--format", action="append", choices=list(BOMBS), dest="formats", help="default: all")
    args = parser.parse_args()
    table = Results(None, args.json).table(
        "bombs", "Files that unpack to far more than they are, or claim to",
        "format; bomb; file|bytes|,; outcome; time|s of processor time|.2f; memory|MiB|.1f",
    )  # fmt: skip
    wrong = []
    for form in args.formats or BOMBS:
        with tempfile.TemporaryDirectory() as scratch:
            made = [make() for make in BOMBS[form].values()]
            nothing = Verdict("", "", 0.0, 0)
            sources = [keep(Path(scratch), Job(form, "", ""), k, files, nothing) for k, files in enumerate(made)]
            found = read_again(sources, Path(scratch, "out"))
        for name, files, result in zip(BOMBS[form], made, found, strict=True):
            size = sum(map(len, files.values()))
            seconds, memory = round(result["seconds"], 3), round(result["memory"] / _MIB, 1)
            table.add(form, name, size, result["kind"], seconds, memory)
            if result["kind"] not in ("read", "refused"):
                wrong.append(f"{form}, {name}: {result['kind']}\n{result['text']}")
    print("\n".join(wrong), file=sys.stderr)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
