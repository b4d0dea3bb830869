"""Run every command that writes twice, and see that it writes the same bytes.

    python -m tools.stress.determinism [--command NAME …] [--json FILE]

The second run has another seed of Python's hashes, another folder, time zone, number of threads, and comes at least
two seconds later: what a file would hold of any of that shows. Reports (.html) tell of times and are left out.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tools.results import Results
from tools.stress.commands import Command, commands, environment, hashes, prepare
from tools.workloads import plain_parser

_CIRCUMSTANCES = (
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "2", "TZ": "Asia/Tokyo", "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
)


def main() -> None:
    parser = plain_parser(__doc__)
    there = [each for each in commands() if each.repeats]
    parser.add_argument("--command", action="append", choices=[each.name for each in there], dest="names")
    args = parser.parse_args()
    chosen = [each for each in there if args.names is None or each.name in args.names]
    columns = "command; files; bytes||,; same bytes"
    table = Results(None, args.json).table("determinism", "Every command twice, in other circumstances", columns)
    different = []
    with tempfile.TemporaryDirectory() as scratch:
        runs, sizes = [], {}
        for number, circumstances in enumerate(_CIRCUMSTANCES):
            folder = Path(scratch, f"run {number}")
            inputs = prepare(folder)
            time.sleep(2 * number)  # time stamps of FAT and of MS-DOS are that coarse
            runs.append({command.name: _run(folder, command, circumstances) for command in chosen})
            if hashes(folder / "in") != inputs:
                raise RuntimeError("a command changed its input")
            sizes = {
                command.name: sum((folder / "out" / _place(command) / name).stat().st_size for name in command.outputs)
                for command in chosen
            }
        for command in chosen:
            one, other = (run[command.name] for run in runs)
            same = sum(one[name] == other[name] for name in command.outputs)
            table.add(command.name, len(command.outputs), sizes[command.name], "yes" if one == other else "no")
            if same != len(command.outputs):
                different.append(command.name)
    sys.exit(f"other bytes the second time: {', '.join(different)}" if different else 0)


def _run(folder: Path, command: Command, circumstances: dict[str, str]) -> dict[str, str]:
    """The hashes of what a command writes."""
    place = folder / "out" / _place(command)
    place.mkdir()
    argv = [part.replace("out", f"out/{place.name}", 1) if part.startswith("out") else part for part in command.argv()]
    done = subprocess.run(
        argv, cwd=folder, env=environment(folder, **circumstances), capture_output=True, text=True, check=False
    )
    written = hashes(place)
    if done.returncode != 0 or set(written) != set(command.outputs):
        raise RuntimeError(f"{command.name} fails:\n{done.stderr}")
    return written


def _place(command: Command) -> str:
    return command.name.replace(" ", "_")


if __name__ == "__main__":
    main()
