"""How fast does the browser's decoder decode, against native C on one core, and in how much memory?

    python -m tools.bench.web FILE.potr... [--rounds 7] [--rate MBIT] [--json FILE]
    python -m tools.bench.web FILE.potr... --tab          # memory of a tab of Chromium, by workers

By Node, whose WebAssembly is Chromium's, in one thread. Native, native without vectors of 512 bits, and both builds
take turns; the first round warms them, and the best of the others counts, in seconds of CPU time. ``python -m
tools.make.web`` builds the decoder.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from unittest import mock

from potr_cl.codec.decoder import open_file
from potr_cl.native.library import VECTORS_VARIABLE
from tools.bench.paired import Asked
from tools.results import ROOT, Results
from tools.workloads import plain_parser, resident

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


def tab_peak(file: Path, workers: int) -> float:
    """Megabytes that a tab of Chromium needs at most to decode a file, more than before."""
    from playwright.sync_api import sync_playwright  # of the extra browser

    handler = partial(SimpleHTTPRequestHandler, directory=str(ROOT / "web"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, sync_playwright() as play:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        chromium = play.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        page = chromium.new_page()
        page.set_default_timeout(600_000)
        page.goto(f"http://127.0.0.1:{server.server_address[1]}/README.md")
        page.set_content('<input type="file">')
        page.set_input_files("input", file)
        before = {pid: resident("VmRSS", pid) / 1e6 for pid in _tabs()}
        page.evaluate(
            "async (workers) => (await import('/dist/potr.js')).decode(document.querySelector('input').files[0], "
            "{ workers }).then((scene) => void (globalThis.scene = scene))",
            workers,
        )
        peak = max(resident("VmHWM", pid) / 1e6 - before[pid] for pid in _tabs() & before.keys())
        chromium.close()
        server.shutdown()
    return peak


def _tabs() -> set[int]:
    """Processes of Chromium that hold pages."""
    lines = {int(path.parent.name): path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")}
    return {pid for pid, line in lines.items() if b"--type=renderer" in line}


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.potr")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--rate", type=float, default=0, metavar="MBIT", help="of a slow server, Mbit/s")
    parser.add_argument("--tab", action="store_true", help="memory of a tab of Chromium, instead")
    args = parser.parse_args()
    if args.tab:
        tabs = Results(None, args.json).table(
            "tab", "Memory of a tab at most, MB more than before", "file; workers; tab|MB|.0f"
        )
        for file in args.files:
            for workers in (0, 1, 2):
                tabs.add(file.name, workers, tab_peak(file, workers))
        return
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
