"""How fast does the browser's decoder decode, against native C on one core, and in how much memory?

    python -m tools.bench.web FILE.potr... [--rounds 7] [--rate MBIT] [--json FILE]

By Node, whose WebAssembly is Chromium's, in one thread. Native, native without vectors of 512 bits, and both builds
take turns; the first round warms them, and the best of the others counts, in seconds of CPU time. ``python -m
tools.make.web`` builds the decoder.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any
from unittest import mock

from potr_cl.codec.decoder import open_file
from potr_cl.codec.native.library import VECTORS_VARIABLE
from tools.bench.paired import Asked
from tools.results import ROOT, Results
from tools.workloads import plain_parser

#: What the native decoder's variable is set to.
_NATIVE = {"native": "1", "narrow": "0"}


def _native(file: Path, vectors: str) -> float:
    with mock.patch.dict(os.environ, {VECTORS_VARIABLE: vectors}):
        begin = time.process_time()
        open_file(file.read_bytes()).scene(threads=1)
        return time.process_time() - begin


def measured(file: Path, rounds: int, rate: float = 0) -> tuple[dict[str, float], dict[str, Any]]:
    """Million splats a second by path; splats, megabytes of the arrays and of Node's peak, and seconds until all is
    decoded from a server of so many Mbit/s."""
    program = ["node", "--expose-gc", str(ROOT / "web" / "test" / "pace.mjs")]
    nodes = {build: Asked([*program, build, str(file)]) for build in ("simd", "general")}
    times: dict[str, list[float]] = {name: [] for name in (*_NATIVE, *nodes)}
    last: dict[str, Any] = {}
    for _ in range(1 + rounds):
        for name, vectors in _NATIVE.items():
            times[name].append(_native(file, vectors))
        for build, node in nodes.items():
            last = node.ask("go")
            times[build].append(last["cpu"])
    slow = min(nodes["simd"].ask(str(rate))["seconds"] for _ in range(rounds)) if rate else None
    peak = nodes["simd"].ask("memory")["peak"] / 1e6
    for node in nodes.values():
        node.end()
    splats, arrays = last["splats"], last["splats"] * 4e-6 * (11 + 3 * (last["degree"] + 1) ** 2)
    paces = {name: splats / min(each[1:]) / 1e6 for name, each in times.items()}
    return paces, {"splats": splats, "arrays": arrays, "peak": peak, "over": slow}


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.potr")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--rate", type=float, default=0, metavar="MBIT", help="of a slow server, Mbit/s")
    args = parser.parse_args()
    both = "{:.2f} ({:.2f}, {:.2f})"
    table = Results(None, args.json).table(
        "web", "The browser's decoder, million splats/s; in brackets of native, and of AVX2",
        f"file; splats||,; native||.2f; AVX2||.2f; SIMD||{both}; without SIMD||{both}; arrays|MB|.0f; "
        "Node's peak|MB|.0f; transfer alone|s|.2f; decoded from the server|s|.2f",
    )  # fmt: skip
    for file in args.files:
        pace, found = measured(file, args.rounds, args.rate)
        builds = ([pace[build], *(pace[build] / pace[other] for other in _NATIVE)] for build in ("simd", "general"))
        alone = file.stat().st_size * 8e-6 / args.rate if args.rate else None
        table.add(
            file.name, found["splats"], pace["native"], pace["narrow"], *builds, found["arrays"], found["peak"], alone,
            found["over"],
        )  # fmt: skip


if __name__ == "__main__":
    main()
