"""What is the time of a fresh command `encode` made of?

    python -m tools.bench.whole_command SCENE.ply CAMERAS [--device DEVICE] [--runs R] [--json FILE]

Runs the command as a user does, judging included, R times after one that builds the kernels, and tells its parts, of
each run's own clock: the interpreter and the imports, opening the device, reading, each stage, judging. Then the same
encode in a process that has done it before. Medians; what several of the parts do at the same time is counted once, in
the whole. Python finds its modules compiled, as ``pip install`` leaves them, whatever the environment says of that.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from potr_cl.formats import load_cameras, load_scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.results import ROOT, Column, Results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--device")
    parser.add_argument("--preset", default="best")
    parser.add_argument("--runs", type=int, default=5, metavar="R")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    table = results.table(
        "parts",
        f"A whole command `encode` of {args.scene.parent.name}, preset {args.preset}, medians of wall times",
        Column("what"),
        Column("time", "ms", ".0f"),
    )
    with tempfile.TemporaryDirectory() as folder:
        parts = command_parts(args, Path(folder))
    for name, milliseconds in parts.items():
        table.add(name, milliseconds)
    scene, cameras = load_scene(args.scene), load_cameras(args.cameras)
    options = EncodeOptions.for_preset(args.preset)
    encode(scene, cameras, options, device=device)
    stages = [encode(scene, cameras, options, device=device).seconds for _ in range(args.runs)]
    for name in stages[0]:
        table.add(f"in process: {name}", _median([each[name] for each in stages]))
    table.add("in process: all", _median([sum(each.values()) for each in stages]))


def command_parts(args: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Milliseconds by part: of pieces of Python that do no more than it, and of what the command tells of itself."""
    told: list[dict[str, float]] = []
    chosen = ["--device", args.device] if args.device else []
    whole = [
        "-m", "potr_cl", "encode", str(args.scene), "-o", str(folder / "scene.potr"),
        "--cameras", str(args.cameras), "--json", "--preset", args.preset, *chosen,
    ]  # fmt: skip
    pieces = {
        "Python alone": ["-c", "pass"],
        "imports of the command, Python with them": ["-c", "import potr_cl.cli.encode"],
        "opening the device, the imports for it with it": [
            "-c", f"from potr_cl.opencl.device import Device; Device({args.device!r})"
        ],
        "whole command": whole,
    }  # fmt: skip
    times: dict[str, list[float]] = {name: [] for name in pieces}
    for run in range(args.runs + 1):
        for name, piece in pieces.items():
            seconds, said = clocked(lambda piece=piece: fresh_python(piece, folder))  # type: ignore[misc]
            if run:  # the first builds the kernels, and compiles the modules
                times[name].append(seconds)
                if name == "whole command":
                    told.append(json.loads(said)["seconds"])
    found = {name: _median(each) for name, each in times.items()}
    found |= {f"of it {name}": _median([each[name] for each in told]) for name in told[0]}
    return found


def fresh_python(arguments: list[str], folder: Path) -> str:
    """What a new interpreter prints that is called with these arguments; its compiled modules stay in the folder."""
    command = [sys.executable, *arguments]
    compiled = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(folder / "compiled")}
    environment = {**os.environ, **compiled}
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, env=environment).stdout


def clocked(work: Callable[[], str]) -> tuple[float, str]:
    """Seconds that some work takes, and what it returns."""
    began = time.perf_counter()
    said = work()
    return time.perf_counter() - began, said


def _median(seconds: list[float]) -> float:
    return round(1e3 * statistics.median(seconds), 1)


if __name__ == "__main__":
    main()
