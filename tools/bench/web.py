"""How fast does the browser's decoder decode, against native C on one core, and in how much memory?

    python -m tools.bench.web FILE.potr... [--rounds 7] [--rate MBIT] [--json FILE]

By Node, whose WebAssembly is Chromium's, in one thread. Native, native without vectors of 512 bits, and both builds
take turns; the first round warms them, and the best of the others counts, in seconds of CPU time. ``python -m
tools.make.web`` builds the decoder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import time
from pathlib import Path
from typing import Any
from unittest import mock

from potr_cl.codec.decoder import open_file
from potr_cl.codec.native.library import VECTORS_VARIABLE

#: What the native decoder's variable is set to.
_NATIVE = {"native": "1", "narrow": "0"}
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


def _native(file: Path, vectors: str) -> float:
    with mock.patch.dict(os.environ, {VECTORS_VARIABLE: vectors}):
        begin = time.process_time()
        open_file(file.read_bytes()).scene(threads=1)
        return time.process_time() - begin


def measured(file: Path, rounds: int, rate: float = 0) -> dict[str, Any]:
    """Seconds by path, and until all is decoded from a server of so many Mbit/s; peak memory of Node, bytes."""
    nodes = {build: _Node(build, file) for build in ("simd", "general")}
    times: dict[str, list[float]] = {name: [] for name in (*_NATIVE, *nodes)}
    last: dict[str, Any] = {}
    for _ in range(1 + rounds):
        for name, vectors in _NATIVE.items():
            times[name].append(_native(file, vectors))
        for build, node in nodes.items():
            last = node.ask("go")
            times[build].append(last["cpu"])
    slow = min(nodes["simd"].ask(str(rate))["seconds"] for _ in range(rounds)) if rate else None
    peaks = {build: node.ask("memory")["peak"] for build, node in nodes.items()}
    for node in nodes.values():
        node.end()
    arrays = last["splats"] * 4 * (11 + 3 * (last["degree"] + 1) ** 2)
    best = {name: min(each[1:]) for name, each in times.items()}
    size = {"bytes": file.stat().st_size, "over": slow}
    return {"file": file.name, **size, "splats": last["splats"], "arrays": arrays, "seconds": best, "peak": peaks}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.potr")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--rate", type=float, default=0, metavar="MBIT", help="of a slow server, Mbit/s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    results = [measured(file, args.rounds, args.rate) for file in args.files]
    heads = (
        "native, million splats/s",
        "AVX2",
        "SIMD (of native, of AVX2)",
        "without SIMD",
        "arrays, MB",
        "Node's peak, MB",
    )
    print(f"| file | splats | {' | '.join(heads)} |")
    print("|---" * (2 + len(heads)) + "|")
    for each in results:
        pace = {name: each["splats"] / seconds / 1e6 for name, seconds in each["seconds"].items()}
        of = {
            name: " ({:.2f}, {:.2f})".format(*(pace[name] / pace[other] for other in _NATIVE))
            for name in ("simd", "general")
        }
        print(
            f"| {each['file']} | {each['splats']:,} | {pace['native']:.2f} | {pace['narrow']:.2f} | "
            f"{pace['simd']:.2f}{of['simd']} | {pace['general']:.2f}{of['general']} | {each['arrays'] / 1e6:.0f} | "
            f"{each['peak']['simd'] / 1e6:.0f} |"
        )
    for each in results if args.rate else ():
        alone = each["bytes"] * 8e-6 / args.rate
        print(
            f"{each['file']} at {args.rate:g} Mbit/s: decoded after {each['over']:.2f} s, {alone:.2f} s of it transfer"
        )
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
