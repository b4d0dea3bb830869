"""Quality and cost of pruning.

    python -m tools.bench.pruning SCENE … [--parts curves skips] [--truth] [--json FILE] [options]

A SCENE is a folder with point_cloud.ply, cameras.json and, for --truth, images. Parts (both by default):

curves  PSNR on test views against the share of splats removed, for our schedule at several numbers of iterations (one
        schedule for each count of survivors) and for other pruners' orders.
skips   the schedule at q = 0.5 with everything computed, and with each of the things that it may skip or do otherwise:
        time, tiles swept, splats kept, and what that costs, also at equal counts.

PSNR is the mean over test views, against the uncompressed scene's renders, and with --truth also what is lost against
the photographs. Prints Markdown; --json writes the raw results.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import read_ground_truth
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.compare import find_ground_truth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import Pruned, PruningOptions
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.results import circumstances
from tools.study.pruning_baselines import KERNELS, mesongs_power, removal_order, scores, transmittance_sums

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]
Row = dict[str, Any]

PARTS = ("curves", "skips")
#: ΔMSE_MAX at q = 0.5.
DELTA_MSE_MAX = 10**-9.8
#: What is lost on the photographs where methods are compared, in dB.
LOSS_LEVEL = 0.4
ONE_ORDER = "one order"


class Bench(Owner):
    """One scene on one device: reference renders, and what pruned versions of it are worth.

    Attributes:
        train, test: the views to prune by and to judge by.
    """

    def __init__(self, folder: Path, device: Device, quick: bool, truth: bool) -> None:
        self.name = folder.name
        self.device = device
        self.scene = load_scene(folder / "point_cloud.ply")
        cameras = load_cameras(folder / "cameras.json")
        every = 4 if quick else 1
        self.train, self.test = train_views(cameras)[::every], test_views(cameras)[::every]
        self.rasterizer = Rasterizer(device, self.scene)
        self._test_renders = self._renders(self.test)
        self._train_renders: list[Image] | None = None
        self._ground_truth: list[Image] | None = None
        if truth:
            files = find_ground_truth(folder / "images", self.test)
            self._ground_truth = [read_ground_truth(files[c.name], self.rasterizer.background) for c in self.test]
            pairs = zip(self._test_renders, self._ground_truth, strict=True)
            self._uncompressed = [decibels(squared_error(render, photograph)) for render, photograph in pairs]
        self._orders: dict[str, Indices] = {}
        self._baselines: dict[str, Indices] = {}
        # Builds every kernel, so that no measurement pays for it.
        self.pruned(self.train[:1], PruningOptions(0, 1, count=len(self.scene) // 2), SweepOptions())

    def _renders(self, cameras: Sequence[Camera]) -> list[Image]:
        return [np.clip(self.rasterizer.render(camera)[0], 0, 1) for camera in cameras]

    def quality(self, survivors: Indices) -> Row:
        """PSNR of what the survivors render against the uncompressed scene, and the loss against the photographs."""
        with Rasterizer(self.device, self.scene.subset(survivors)) as rasterizer:
            renders, losses = [], []
            for number, camera in enumerate(self.test):
                image = rasterizer.render(camera)[0]
                renders.append(decibels(squared_error(image, self._test_renders[number])))
                if self._ground_truth is not None:
                    error = squared_error(image, self._ground_truth[number])
                    losses.append(self._uncompressed[number] - decibels(error))
        row: Row = {"kept": len(survivors), "psnr": statistics.mean(renders)}
        if losses:
            row["loss"] = statistics.mean(losses)
        return row

    def train_psnr(self, survivors: Indices) -> float:
        """PSNR of the mean squared error over all training views: what pruning tries to keep."""
        if self._train_renders is None:
            self._train_renders = self._renders(self.train)
        with Rasterizer(self.device, self.scene.subset(survivors)) as rasterizer:
            errors = [
                squared_error(rasterizer.render(camera)[0], reference)
                for camera, reference in zip(self.train, self._train_renders, strict=True)
            ]
        return decibels(statistics.mean(errors))

    def pruned(self, cameras: Sequence[Camera], options: PruningOptions, sweep: SweepOptions) -> tuple[Pruned, Row]:
        """Run a schedule; its result and its cost in seconds and full sweeps."""
        started = time.perf_counter()
        with RemovalSweep(self.rasterizer, cameras, sweep) as removal:
            prepared = time.perf_counter()
            result = prune_scene(removal, options)
            self.device.queue.finish()
            ended = time.perf_counter()
            sweeps = removal.sweeps
        return result, {
            "prepare_seconds": prepared - started,
            "seconds": ended - started,
            "sweeps": sweeps,
            "rounds": result.iterations,
        }

    def ours(self, kept: int, iterations: int) -> tuple[Pruned, Row]:
        """Our schedule to an exact count, at the default skips."""
        return self.pruned(self.train, PruningOptions(0, iterations, count=kept), SweepOptions())

    def one_order(self, kept: int, iterations: int) -> Indices:
        """The order of one schedule down to ``kept`` survivors, made once."""
        key = f"{kept} {iterations}"
        if key not in self._orders:
            self._orders[key] = self.ours(kept, iterations)[0].order
        return self._orders[key]

    def baselines(self) -> dict[str, Indices]:
        """The other pruners' orders."""
        if not self._baselines:
            with RemovalSweep(self.rasterizer, self.train, SweepOptions(transmittance_threshold=None)) as sweep:
                importance = sweep.measure()[1]
            transmittance = transmittance_sums(self.rasterizer, self.train)
            found = scores(self.scene, importance, transmittance, mesongs_power(self.name))
            self._baselines = {name: removal_order(score) for name, score in found.items()}
        return self._baselines

    def close(self) -> None:
        """Give the device's memory back."""
        self.rasterizer.close()


def log(text: str) -> None:
    """Progress, to standard error."""
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


def squared_error(image: Image, reference: Image) -> float:
    """Mean over pixels and channels; the reference is clamped already."""
    difference = (np.clip(image, 0, 1) - reference).ravel()
    return float(difference @ difference) / difference.size


def decibels(error: float) -> float:
    """PSNR of a mean squared error."""
    return -10 * math.log10(error) if error > 0 else math.inf


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
        pruning: other options of the schedule.
    """

    name: str
    iterations: int
    sweep: SweepOptions = dataclasses.field(default_factory=SweepOptions)
    every: int = 1
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
    settings += [Setting(f"tolerance {t:g}", most, SweepOptions(t)) for t in (0.002, 0.005, 0.01, 0.02, 0.05)]
    settings += [Setting(f"{n} iterations", n) for n in fewer]
    settings += [Setting(f"views in {n} turns", most, SweepOptions(turns=n)) for n in (2, 4)]
    settings += [Setting(f"every {name} view", most, every=n) for name, n in (("2nd", 2), ("4th", 4))]
    return settings


def skips(bench: Bench, iterations: Sequence[int]) -> list[Row]:
    """One row a setting. Equal counts: each order is cut where the full computation ended."""
    rows: list[Row] = []
    for setting in skip_settings(iterations):
        options = PruningOptions(DELTA_MSE_MAX, setting.iterations, **setting.pruning)
        views = bench.train[:: setting.every]
        result, cost = bench.pruned(views, options, setting.sweep)
        cost["sweeps"] *= len(views) / len(bench.train)
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


def _at(rows: Sequence[Row], level: float) -> float | None:
    """The share removed at which a curve's loss reaches ``level`` dB, by interpolation from nothing removed."""
    points = [(0.0, 0.0), *sorted((r["removed"], r["loss"]) for r in rows)]
    for (share0, loss0), (share1, loss1) in itertools.pairwise(points):
        if loss0 <= level < loss1:
            return float(share0 + (share1 - share0) * (level - loss0) / (loss1 - loss0))
    return None


def print_curves(rows: Sequence[Row]) -> None:
    """PSNR and loss by method and share."""
    shares = sorted({r["removed"] for r in rows})
    methods = list(dict.fromkeys(r["method"] for r in rows))
    truth = "loss" in rows[0]
    print("| removed | " + " | ".join(f"{s:.0%}" for s in shares) + (" | kept at 0.4 dB |" if truth else " |"))
    print("|---" * (len(shares) + 1 + truth) + "|")
    for method in methods:
        mine = {r["removed"]: r for r in rows if r["method"] == method}
        cells = [
            f"{mine[s]['psnr']:.1f}" + (f" / {mine[s]['loss']:.2f}" if truth else "") if s in mine else ""
            for s in shares
        ]
        if truth:
            removed = _at(list(mine.values()), LOSS_LEVEL)
            cells.append("" if removed is None else f"{1 - removed:.1%}")
        print(f"| {method} | " + " | ".join(cells) + " |")


def pareto(rows: Sequence[Row]) -> list[Row]:
    """The rows that no other beats in both time and PSNR at equal count, by ascending time."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda r: (r["seconds"], -r["psnr_at_equal_count"])):
        if not front or row["psnr_at_equal_count"] > front[-1]["psnr_at_equal_count"]:
            front.append(row)
    return front


def print_skips(rows: Sequence[Row]) -> None:
    """Cost and error of each setting; those on the Pareto front in bold."""
    front = {r["skipped"] for r in pareto(rows)}
    full = rows[0]
    truth = "loss" in full
    print(
        "| skipped | iterations | s | of it preparing | full sweeps | kept | PSNR |"
        + (" loss by photo |" if truth else "")
        + " PSNR at equal count | against the full computation | on training views |"
    )
    print("|---" * (10 + truth) + "|")
    for r in rows:
        name = f"**{r['skipped']}**" if r["skipped"] in front else r["skipped"]
        print(
            f"| {name} | {r['iterations']} | {r['seconds']:.2f} | {r['prepare_seconds']:.2f} | {r['sweeps']:.1f} | "
            f"{r['kept']:,} | {r['psnr']:.2f} | "
            + (f"{r['loss']:.3f} | " if truth else "")
            + f"{r['psnr_at_equal_count']:.2f} | {r['psnr_at_equal_count'] - full['psnr_at_equal_count']:+.2f} | "
            f"{r['train_psnr_at_equal_count'] - full['train_psnr_at_equal_count']:+.2f} |"
        )


def run(arguments: argparse.Namespace) -> Row:
    """Measure what the command line asks for."""
    device = Device(arguments.device, variants=KERNELS)
    results: Row = {**circumstances(device.info), "device": device.info.name, "scenes": {}}
    for folder in arguments.scenes:
        with Bench(folder, device, arguments.quick, arguments.truth) as bench:
            found: Row = {"splats": len(bench.scene), "train": len(bench.train), "test": len(bench.test)}
            results["scenes"][folder.name] = found
            if "curves" in arguments.parts:
                found["curves"] = curves(bench, [p / 100 for p in arguments.removed], arguments.iterations)
            if "skips" in arguments.parts:
                found["skips"] = skips(bench, arguments.iterations)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--device")
    parser.add_argument("--quick", action="store_true", help="every 4th training view, every 4th test view")
    parser.add_argument("--truth", action="store_true", help="judge by the photographs too")
    parser.add_argument("--removed", nargs="+", type=float, default=list(range(10, 90, 10)), help="per cent")
    parser.add_argument("--iterations", nargs="+", type=int, default=[1, 4, 8, 16, 48])
    parser.add_argument("--json", type=Path, help="write the raw results here")
    arguments = parser.parse_args()
    results = run(arguments)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")
    for name, found in results["scenes"].items():
        print(f"\n## {name}: {found['splats']:,} splats, {found['train']} training and {found['test']} test views")
        print(f"\n{results['device']}")
        for part, printer in (("curves", print_curves), ("skips", print_skips)):
            if part in found:
                print(f"\n### {part}\n")
                printer(found[part])


if __name__ == "__main__":
    main()
