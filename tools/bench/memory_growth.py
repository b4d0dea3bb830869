"""Peak memory of an encode against splats and views, and whether --memory is obeyed.

    python -m tools.bench.memory_growth [--splats N …] [--views N …] [--size WxH] [options]

Scenes of any size are drawn from a trained one (tools.make.large_scene). Each encode runs in a process of its own, so
that its peak is its own; the host's is the kernel's figure (Linux only) less what the process held before the encode,
the device's is what was allocated at most. On CPU devices the device's memory is the host's and counts there too. The
peaks, of the views that are given and none between them, are fitted by

    bytes = constant + a splats + b views + c splats views

--memory is what the views may take, in pruning and in the re-fit each: by so much may the device's peak of a stage
exceed that of an encode that keeps no view.
Prints Markdown; --json keeps the tables.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyopencl as cl

from potr_cl.codec.quantize import PRESETS, Preset
from potr_cl.formats import load_cameras, load_scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.bench.memory import reset_peak, resident
from tools.make.large_scene import DEFAULT_SCENE, EXCERPT, cameras_beside, large_scene, more_views
from tools.results import Column, Results

#: Parts of what the views would take that --memory is tried with.
SHARES = (0.0, 0.1, 0.3, 0.6, 0.9)


class CountingDevice(Device):
    """A device that knows the most that was allocated on it, stage by stage."""

    stage = ""

    def __init__(self, spec: str | None = None) -> None:
        self.peaks: dict[str, float] = {}
        super().__init__(spec)

    def allocate(self, nbytes: int, what: str) -> cl.Buffer:
        buffer = super().allocate(nbytes, what)
        self.peaks[self.stage] = max(self.peaks.get(self.stage, 0), self.allocated)
        return buffer

    def enter(self, stage: str, _done: float) -> None:
        """Take an encode's progress. To prepare views is part of the pruning."""
        self.stage = "prune" if stage == "prepare views" else stage


@dataclasses.dataclass(frozen=True)
class Point:
    """One encode and its peaks, in bytes; ``memory`` is the budget of the views, None the default."""

    splats: int
    views: int
    memory: int | None
    host: float = 0.0
    device: float = 0.0
    scene: float = 0.0
    stages: dict[str, float] = dataclasses.field(default_factory=dict)


def measure(point: Point, like: Path, size: tuple[int, int], preset: Preset, rounds: int, spec: str | None) -> Point:
    """The encode, in this process."""
    scene = large_scene(load_scene(like), point.splats, split=True)
    entries = more_views(load_cameras(cameras_beside(like)), point.views, *size)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.json"
        path.write_text(json.dumps(entries))
        cameras = load_cameras(path)
    device = CountingDevice(spec)
    # As many views as are said: of few views, others between them would be looked at too.
    options = EncodeOptions.for_preset(preset, between=False, prune={"iterations": rounds}, memory=point.memory)
    before = resident("VmRSS")
    reset_peak()
    encode(scene, cameras, options, device.enter, device)
    host = 1e9 * (resident("VmHWM") - before)
    peak = max(device.peaks.values())
    return dataclasses.replace(point, host=host, device=peak, scene=scene.nbytes, stages=device.peaks)


def in_process(point: Point, arguments: Sequence[str]) -> Point:
    """The same in a process of its own."""
    memory = [] if point.memory is None else ["--memory", str(point.memory)]
    command = [sys.executable, "-m", "tools.bench.memory_growth", "--one", str(point.splats), str(point.views)]
    done = subprocess.run([*command, *memory, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr.strip() or f"exit code {done.returncode}")
    found = Point(**json.loads(done.stdout.splitlines()[-1]))
    memory_text = "" if found.memory is None else f", {found.memory / 1e6:.1f} MB for views"
    print(f"{found.splats} splats, {found.views} views{memory_text}: done", file=sys.stderr, flush=True)
    return found


def fitted(points: Sequence[Point], key: str) -> tuple[list[float], float]:
    """Constant, a, b and c, and the largest relative deviation."""
    n, v = (np.array([getattr(p, name) for p in points], np.float64) for name in ("splats", "views"))
    columns = np.stack([np.ones_like(n), n, v, n * v], axis=1)
    peaks = np.array([getattr(p, key) for p in points])
    scale = columns.max(axis=0)
    solution = np.linalg.lstsq(columns / scale / peaks[:, None], np.ones_like(peaks), rcond=None)[0] / scale
    return solution.tolist(), float(np.abs(columns @ solution / peaks - 1).max())


def keep_growth(points: Sequence[Point], results: Results, what: str) -> None:
    """The tables of peaks and of the lines through them."""
    table = results.table(
        "growth",
        f"Peaks of memory by splats and views, {what}",
        Column("splats", format=","),
        Column("views"),
        Column("scene", "MB", ".1f"),
        Column("host peak", "MB", ".1f"),
        Column("device peak", "MB", ".1f"),
    )
    for p in points:
        table.add(p.splats, p.views, p.scene / 1e6, p.host / 1e6, p.device / 1e6)
    table = results.table(
        "growth_fit",
        "A fit of those peaks: constant, by splats, by views, by both",
        Column("peak"),
        Column("constant", "MB", ".1f"),
        Column("bytes a splat", format=".0f"),
        Column("a view", "kB", ".1f"),
        Column("bytes a splat and view", format=".1f"),
        Column("largest deviation", "%", ".1f"),
    )
    for key in ("host", "device"):
        (constant, a, b, c), deviation = fitted(points, key)
        table.add(key, constant / 1e6, a, b / 1e3, c, 100 * deviation)


def keep_budgets(points: Sequence[Point], unlimited: Point, results: Results) -> None:
    """The table of what the views took, against what they might. The first point is that of views that keep nothing."""
    nothing = points[0]
    taken = most_taken(unlimited, nothing) / 1e6
    table = results.table(
        "budget",
        f"{unlimited.splats:,} splats, {unlimited.views} views, which take {taken:.1f} MB if they may",
        Column("`--memory`", "MB", ".1f"),
        Column("device peak of a stage above that without any view", "MB", ".1f"),
        Column("of the budget", "%", ".0f"),
    )
    for p in points[1:]:
        assert p.memory is not None
        table.add(p.memory / 1e6, most_taken(p, nothing) / 1e6, 100 * most_taken(p, nothing) / p.memory)


def most_taken(point: Point, nothing: Point) -> float:
    """What views took in the stage in which they took most."""
    return max(peak - nothing.stages.get(stage, 0) for stage, peak in point.stages.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, nargs="+", default=[250_000, 500_000, 1_000_000, 2_000_000])
    parser.add_argument("--views", type=int, nargs="+", default=[25, 100])
    parser.add_argument("--size", default="800x532", metavar="WxH")
    parser.add_argument("--like", type=Path, default=DEFAULT_SCENE if DEFAULT_SCENE.exists() else EXCERPT)
    parser.add_argument("--preset", choices=PRESETS, default=EncodeOptions.preset)
    parser.add_argument("--iterations", type=int, default=4, help="of pruning: memory does not depend on it")
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--one", type=int, nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        width, height = map(int, args.size.split("x"))
        point = Point(args.one[0], args.one[1], args.memory)
        found = measure(point, args.like, (width, height), args.preset, args.iterations, args.device)
        print(json.dumps(dataclasses.asdict(found)))
        return
    passed = ["--size", args.size, "--like", str(args.like), "--preset", args.preset]
    passed += ["--iterations", str(args.iterations), *(["--device", args.device] if args.device else [])]
    points = [in_process(Point(n, v, None), passed) for n, v in itertools.product(args.splats, args.views)]
    # Of the middle size, so that the largest does not decide how long it takes.
    middle = points[len(args.views) * (len(args.splats) // 2) + len(args.views) - 1]
    budgets = [in_process(Point(middle.splats, middle.views, 0), passed)]
    whole = most_taken(middle, budgets[0])
    budgets += [in_process(Point(middle.splats, middle.views, int(s * whole)), passed) for s in SHARES if s]
    results = Results(Device(args.device).info, args.json)
    keep_growth(points, results, f"{args.size.replace('x', ' x ')} pixels a view, preset {args.preset}")
    keep_budgets(budgets, middle, results)


if __name__ == "__main__":
    main()
