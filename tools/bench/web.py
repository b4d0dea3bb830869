"""How fast does the browser's decoder decode, against native C on one core, and in how much memory?

    python -m tools.bench.web FILE.potr... [--rounds 7] [--json FILE]

By Node, whose WebAssembly is Chromium's, in one thread; native and both builds take turns, and the best round of each
counts, in seconds of CPU time. ``python -m tools.make.web`` builds it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path
from typing import Any

from potr_cl.codec.decoder import open_file

_PROGRAM = Path(__file__).parents[2] / "web" / "test" / "pace.mjs"


class _Node:
    """A decode at a time, when asked."""

    def __init__(self, build: str, file: Path) -> None:
        command = ["node", "--expose-gc", str(_PROGRAM), build, str(file)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, line: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(line, file=self._process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def end(self) -> None:
        self._process.communicate()


def _native(file: Path) -> float:
    begin = time.process_time()
    open_file(file.read_bytes()).scene(threads=1)
    return time.process_time() - begin


def measured(file: Path, rounds: int) -> dict[str, Any]:
    """Seconds by path, splats and peak memory of Node, bytes."""
    nodes = {build: _Node(build, file) for build in ("simd", "general")}
    times: dict[str, list[float]] = {name: [] for name in ("native", *nodes)}
    last: dict[str, Any] = {}
    for _ in range(rounds):
        times["native"].append(_native(file))
        for build, node in nodes.items():
            last = node.ask("go")
            times[build].append(last["cpu"])
    peaks = {build: node.ask("memory")["peak"] for build, node in nodes.items()}
    for node in nodes.values():
        node.end()
    arrays = last["splats"] * 4 * (11 + 3 * (last["degree"] + 1) ** 2)
    best = {name: min(each) for name, each in times.items()}
    return {"file": file.name, "splats": last["splats"], "arrays": arrays, "seconds": best, "peak": peaks}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.potr")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    results = [measured(file, args.rounds) for file in args.files]
    heads = ("SIMD", "of native", "without SIMD", "of native", "arrays, MB", "Node's peak, MB")
    print(f"| file | splats | native, M splats/s | {' | '.join(heads)} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for each in results:
        native, simd, general = (each["splats"] / each["seconds"][name] / 1e6 for name in ("native", "simd", "general"))
        print(
            f"| {each['file']} | {each['splats']:,} | {native:.2f} | {simd:.2f} | {simd / native:.2f} | "
            f"{general:.2f} | {general / native:.2f} | {each['arrays'] / 1e6:.0f} | {each['peak']['simd'] / 1e6:.0f} |"
        )
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
