"""Whole encodes by two checkouts of the package, in turns: is one faster than the other?

Two processes stay alive, one for each checkout; each reads the scene once and encodes it when it is told to. They take
turns, and who begins alternates, so that whatever slows the machine down meets both alike. What counts is the median of
the ratios of the pairs.

    git worktree add ../before COMMIT
    python -m tools.bench.paired ../before --scene point_cloud.ply --cameras cameras.json --preset best --rounds 20
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from tools.results import ROOT, Results
from tools.workloads import plain_parser

#: What each process runs. It uses only names that every version of the package has had.
_WORKER = """
import hashlib, json, sys, time
import potr_cl
scene = potr_cl.load_scene(sys.argv[1])
cameras = potr_cl.load_cameras(sys.argv[2]) if sys.argv[2] else None
options = potr_cl.EncodeOptions.for_preset(sys.argv[3])
device = None
for _ in sys.stdin:
    begin, worked = time.perf_counter(), time.process_time()
    encoded = potr_cl.encode(scene, cameras, options, None, device)
    seconds, worked = time.perf_counter() - begin, time.process_time() - worked
    device = encoded.device
    digest = hashlib.sha256(b"".join(bytes(piece) for piece in encoded.pieces)).hexdigest()
    print(json.dumps({"wall": seconds, "processor": worked, "bytes": encoded.nbytes, "sha256": digest}), flush=True)
"""


class Asked:
    """A process that answers each line with one of JSON; its package is that of a folder, where one is given."""

    def __init__(self, command: list[str], folder: Path | None = None) -> None:
        path = os.pathsep.join(str(each) for each in (folder, os.environ.get("PYTHONPATH")) if each)
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen(command, cwd=folder, env={**os.environ, "PYTHONPATH": path}, **pipes)

    def ask(self, line: str = "") -> dict[str, Any]:
        """Tell it a line and wait for the answer.

        Raises:
            SystemExit: the process has ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(line, file=self._process.stdin, flush=True)
        said = self._process.stdout.readline()
        if not said:
            sys.exit(f"a process ended with {self._process.wait()}: {' '.join(self._process.args)[:300]}")  # type: ignore[arg-type]
        answer: dict[str, Any] = json.loads(said)
        return answer

    def end(self) -> None:
        self._process.communicate()


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--preset", default="best")
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()
    cameras = str(args.cameras.resolve()) if args.cameras else ""
    command = [sys.executable, "-c", _WORKER, str(args.scene.resolve()), cameras, args.preset]
    checkouts = {"before": Asked(command, args.before.resolve()), "now": Asked(command, ROOT)}
    measured: dict[str, list[dict[str, Any]]] = {name: [] for name in checkouts}
    warm = {name: checkout.ask() for name, checkout in checkouts.items()}  # builds its kernels
    for number in range(args.rounds):
        for name in ("before", "now") if number % 2 else ("now", "before"):
            measured[name].append(checkouts[name].ask())
    for checkout in checkouts.values():
        checkout.end()
    table = Results(None, args.json).table(
        "paired", f"Whole encodes in turns, {args.rounds} pairs, preset {args.preset}; medians",
        "clock; before|s|.3f; now|s|.3f; ratio of pairs||.4f; middle half of ratios||{:.4f} to {:.4f}",
    )  # fmt: skip
    for clock in ("wall", "processor"):
        before, now = ([each[clock] for each in measured[name]] for name in checkouts)
        ratios = [b / a for a, b in zip(before, now, strict=True)]
        low, middle, high = statistics.quantiles(ratios, n=4)
        table.add(clock, statistics.median(before), statistics.median(now), middle, [low, high])
    print(f"\nbytes: {warm['before']['bytes']} before, {warm['now']['bytes']} now")
    print(f"same file: {warm['before']['sha256'] == warm['now']['sha256']}")


if __name__ == "__main__":
    main()
