"""Quality, cost and gain of pruning.

    python -m tools.bench.pruning SCENE … [options] | --plot FILE …

A SCENE is a folder with point_cloud.ply, cameras.json and, for --truth, images. Parts (all by default):

curves  PSNR on test views against the share of splats removed, for our schedule at several numbers of iterations (one
        schedule for each count of survivors) and for other pruners' orders.
skips   the schedule at q = 0.5 with everything computed, and with each of the things that it may skip or do otherwise:
        time, tiles swept, splats kept, and what that costs, also at equal counts.
frames  frames a second before pruning, and after it at an equal loss, by our order and by the best of the others.

PSNR is the mean over test views, against the uncompressed scene's renders, and with --truth also what is lost against
the photographs. Prints Markdown; --json writes the raw results, and --plot makes the pictures of such files (it needs
matplotlib) and prints their tables again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.bench.pruned_scene import Bench, log
from tools.bench.pruning_report import LOSS_LEVELS, ONE_ORDER, PSNR_LEVELS, plot, print_results
from tools.results import circumstances
from tools.study.pruning_baselines import KERNELS
from tools.workloads import scaled

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]
Row = dict[str, Any]

PARTS = ("curves", "skips", "frames")
#: ΔMSE_MAX at q = 0.5.
DELTA_MSE_MAX = 10**-9.8
IMAGES = Path(__file__).parents[2] / "docs" / "images"


def ours_name(iterations: int) -> str:
    """What our schedule is called in tables and plots."""
    return f"ours, {iterations} iteration{'s' if iterations > 1 else ''}"


def curves(bench: Bench, shares: Sequence[float], iterations: Sequence[int]) -> list[Row]:
    """One row a method and share removed."""
    splats = len(bench.scene)
    counts = {share: round(splats * (1 - share)) for share in shares}
    rows: list[Row] = []

    def add(method: str, share: float, survivors: Indices, cost: Row) -> None:
        rows.append({"method": method, "removed": share, **bench.quality(survivors), **cost})
        log(f"{bench.name}: {method}, {share:.0%} removed: {rows[-1]['psnr']:.2f} dB")

    for name, order in bench.baselines().items():
        for share, kept in counts.items():
            add(name, share, order[splats - kept :], {})
    for rounds in iterations:
        for share, kept in counts.items():
            result, cost = bench.ours(kept, rounds)
            add(ours_name(rounds), share, result.survivors, cost)
    order = bench.one_order(min(counts.values()), max(iterations))
    for share, kept in counts.items():
        add(f"{ours_name(max(iterations))}, {ONE_ORDER}", share, order[splats - kept :], {})
    return rows


@dataclasses.dataclass(frozen=True)
class Setting:
    """One row of the skips.

    Attributes:
        name: what is skipped.
        iterations: of the schedule.
        sweep: what its measurements skip.
        every: only each so many-th training view counts.
        half: measurements, after the first, that look at views of half the size; -1: all.
        pruning: other options of the schedule.
    """

    name: str
    iterations: int
    sweep: SweepOptions = dataclasses.field(default_factory=SweepOptions)
    every: int = 1
    half: int = 0
    pruning: Row = dataclasses.field(default_factory=dict)


def skip_settings(iterations: Sequence[int]) -> list[Setting]:
    """The full computation first; with one and two iterations less it says how far results scatter that ought to be
    the same."""
    most = max(iterations)
    fewer = [n for n in sorted({*iterations, 24, 32}) if 1 < n < most]
    full = SweepOptions(0)
    settings = [Setting("nothing", most, full)]
    settings += [Setting(f"nothing, {most - n} iterations", most - n, full) for n in (1, 2) if most > n]
    settings += [Setting(f"nothing, damping {d:g}", most, full, pruning={"decay": d}) for d in (0, 0.5, 0.9, 1)]
    settings += [Setting(f"nothing, a = {a:g}", most, full, pruning={"a": a}) for a in (1, 100)]
    settings += [
        Setting(f"nothing, pixels end at {e:.0e}", most, SweepOptions(0, transmittance_threshold=e))
        for e in (1e-6, 1e-8)
    ]
    settings += [Setting("what touches no pixel", most, SweepOptions(0, tighten=True))]
    settings += [Setting(f"tolerance {t:g}", most, SweepOptions(t)) for t in (0.002, 0.005, 0.01, 0.02, 0.05)]
    settings.append(Setting("tolerance 0.002, damping 0", most, pruning={"decay": 0}))
    settings += [Setting(f"{n} iterations", n) for n in fewer]
    settings += [Setting(f"views in {n} turns", most, SweepOptions(turns=n)) for n in (2, 4)]
    settings += [Setting(f"{n} iterations, views in 4 turns", n, SweepOptions(turns=4)) for n in fewer[-3:]]
    settings += [
        Setting(f"tiles but {p:.0%} at random, {when}", most, SweepOptions(sample=p, sampled=number))
        for when, number in (("first half", most // 2), ("always", most))
        for p in (0.5, 0.25)
    ]
    settings += [Setting(f"every {name} view", most, every=n) for name, n in (("2nd", 2), ("4th", 4))]
    settings += [Setting(f"half-size views, {w}", most, half=n) for w, n in (("first half", most // 2), ("always", -1))]
    return settings


def skips(bench: Bench, iterations: Sequence[int]) -> list[Row]:
    """One row a setting. Equal counts: each order is cut where the full computation ended."""
    rows: list[Row] = []
    for setting in skip_settings(iterations):
        options = PruningOptions(DELTA_MSE_MAX, setting.iterations, **setting.pruning)
        views = bench.train[:: setting.every]
        if setting.half < 0:
            views = [scaled(c, 0.5) for c in views]
        result, cost = bench.pruned(views, options, setting.sweep, max(setting.half, 0))
        cost["sweeps"] *= sum(c.width * c.height for c in views) / sum(c.width * c.height for c in bench.train)
        kept = rows[0]["kept"] if rows else result.kept
        at_equal_count = result.order[len(result.order) - kept :]
        own, equal = bench.quality(result.survivors), bench.quality(at_equal_count)
        rows.append(
            {
                "skipped": setting.name,
                "iterations": setting.iterations,
                "views": len(views),
                **own,
                "psnr_at_equal_count": equal["psnr"],
                "train_psnr_at_equal_count": bench.train_psnr(at_equal_count),
                **cost,
            }
        )
        log(f"{bench.name}: skipping {setting.name}: {cost['seconds']:.1f} s, {equal['psnr']:.2f} dB")
    return rows


def frame_rate(rasterizer: Rasterizer, cameras: Sequence[Camera], passes: int = 5) -> float:
    """Frames a second, finished one by one and left on the device: each view at the best of several passes."""
    best = [math.inf] * len(cameras)
    for _ in range(passes):
        for number, camera in enumerate(cameras):
            started = time.perf_counter()
            rasterizer.render_device(camera)
            best[number] = min(best[number], time.perf_counter() - started)
    return 1 / statistics.mean(best)


def rendering_cost(bench: Bench, survivors: Indices) -> Row:
    """Frame rate over the training views and the intersections in their tile lists."""
    with Rasterizer(bench.device, bench.scene.subset(survivors)) as rasterizer:
        rate = frame_rate(rasterizer, bench.train)
        intersections = []
        for camera in bench.train[::8]:
            with rasterizer.prepare(camera) as view:
                intersections.append(view.intersection_count)
    return {"frames_per_second": rate, "intersections": statistics.mean(intersections)}


def fewest(bench: Bench, order: Indices, good: Callable[[Row], bool], low: int, high: int, steps: int) -> Row:
    """Quality and cost of the fewest splats that are still good, by bisection of the length of an order's end.

    Args:
        low, high: counts, one too small and one large enough.
    """
    for _ in range(steps):
        middle = (low + high) // 2
        if good(bench.quality(order[len(order) - middle :])):
            high = middle
        else:
            low = middle
    survivors = order[len(order) - high :]
    return {**bench.quality(survivors), **rendering_cost(bench, survivors)}


def frames(bench: Bench, truth: bool, iterations: int) -> list[Row]:
    """Rows at each level of loss: unpruned, the other pruners, ours."""
    splats = len(bench.scene)
    rows: list[Row] = []
    unpruned = rendering_cost(bench, np.arange(splats, dtype=np.int64))
    orders = {name: bench.baselines()[name] for name in ("LightGaussian", "MesonGS", "importance")}
    for level in LOSS_LEVELS if truth else PSNR_LEVELS:

        def good(row: Row, level: float = level) -> bool:
            return bool(row["loss"] <= level if truth else row["psnr"] >= level)

        rows.append({"level": level, "method": "unpruned", "kept": splats, **unpruned})
        for name, order in orders.items():
            rows.append({"level": level, "method": name, **fewest(bench, order, good, 0, splats, 9)})
        # One long order tells nearly how many are needed, a schedule to that count then orders the last few better.
        near = fewest(bench, bench.one_order(splats // 5, iterations), good, 0, splats, 6)["kept"]
        order = bench.ours(near, iterations)[0].order
        ours = fewest(bench, order, good, round(0.85 * near), round(1.05 * near), 5)
        rows.append({"level": level, "method": ours_name(iterations), **ours})
        log(f"{bench.name}: level {level:g} done")
    return rows


def merged(files: Sequence[Path]) -> Row:
    """The parts of several result files together."""
    results: Row = {"scenes": {}}
    for file in files:
        found = json.loads(file.read_text())
        results["device"] = found["device"]
        for name, scene in found["scenes"].items():
            results["scenes"].setdefault(name, {}).update(scene)
    return results


def run(arguments: argparse.Namespace) -> Row:
    """Measure what the command line asks for."""
    device = Device(arguments.device, variants=KERNELS)
    about = circumstances(device.info)
    results: Row = {**about, "device": device.info.name, "quick": arguments.quick, "scenes": {}}
    for folder in arguments.scenes:
        started = time.perf_counter()
        with Bench(folder, device, arguments.quick, arguments.truth) as bench:
            found: Row = {"splats": len(bench.scene), "train": len(bench.train), "test": len(bench.test)}
            results["scenes"][folder.name] = found
            log(f"{folder.name}: {len(bench.scene)} splats, {time.perf_counter() - started:.1f} s to load")
            if "curves" in arguments.parts:
                found["curves"] = curves(bench, [p / 100 for p in arguments.removed], arguments.iterations)
                log(f"{folder.name}: curves done after {time.perf_counter() - started:.1f} s")
            if "skips" in arguments.parts:
                found["skips"] = skips(bench, arguments.iterations)
                log(f"{folder.name}: skips done after {time.perf_counter() - started:.1f} s")
            if "frames" in arguments.parts:
                found["frames"] = frames(bench, arguments.truth, max(arguments.iterations))
                log(f"{folder.name}: frames done after {time.perf_counter() - started:.1f} s")
    return results


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--device")
    parser.add_argument("--quick", action="store_true", help="every 4th training view, every 4th test view")
    parser.add_argument("--truth", action="store_true", help="judge by the photographs too")
    parser.add_argument("--removed", nargs="+", type=float, default=list(range(10, 90, 10)), help="per cent")
    parser.add_argument("--iterations", nargs="+", type=int, default=[1, 4, 8, 16, 48])
    parser.add_argument("--json", type=Path, help="write the raw results here")
    parser.add_argument("--plot", nargs="+", type=Path, help="result files to make pictures and tables of")
    parser.add_argument("--images", type=Path, default=IMAGES, help="folder for the pictures")
    arguments = parser.parse_args()
    if bool(arguments.scenes) == bool(arguments.plot):
        parser.error("give scenes to measure, or result files with --plot")
    if arguments.plot:
        results = merged(arguments.plot)
        plot(results, arguments.images)
    else:
        results = run(arguments)
        if arguments.json:
            arguments.json.write_text(json.dumps(results, indent=1) + "\n")
    print_results(results)


if __name__ == "__main__":
    main()
