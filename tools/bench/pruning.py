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
import itertools
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
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
from potr_cl.stages.pruning.schedule import Pruned, PruningOptions, prune
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.results import circumstances
from tools.study.pruning_baselines import KERNELS, mesongs_power, removal_order, scores, transmittance_sums
from tools.workloads import scaled

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]
Row = dict[str, Any]

PARTS = ("curves", "skips", "frames")
#: ΔMSE_MAX at q = 0.5.
DELTA_MSE_MAX = 10**-9.8
#: The losses at which methods are compared: in dB against the photographs, or PSNR against the uncompressed renders.
LOSS_LEVELS = (0.4, 2.0)
PSNR_LEVELS = (45.0, 40.0)
ONE_ORDER = "one order"
IMAGES = Path(__file__).parents[2] / "docs" / "images"


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

    def pruned(
        self, cameras: Sequence[Camera], options: PruningOptions, sweep: SweepOptions, half: int = 0
    ) -> tuple[Pruned, Row]:
        """Run a schedule, so many of its measurements of half-size views; its result and its cost in seconds and full
        sweeps."""
        started = time.perf_counter()
        with ExitStack() as owned:
            removal = owned.enter_context(RemovalSweep(self.rasterizer, cameras, sweep))
            small: RemovalSweep | None = None
            if half:
                small = owned.enter_context(RemovalSweep(self.rasterizer, [scaled(c, 0.5) for c in cameras], sweep))
            prepared = time.perf_counter()
            if small:
                result = prune(HalfSizeFirst(removal, small, half), len(self.scene), options)
            else:
                result = prune_scene(removal, options)
            self.device.queue.finish()
            ended = time.perf_counter()
            sweeps = removal.sweeps
            if small:
                sweeps += small.sweeps / 4
        return result, {
            "prepare_seconds": prepared - started,
            "prune_seconds": ended - prepared,
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


# ---------------------------------------------------------------------------------------------- parts


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


class HalfSizeFirst:
    """Removal effects of which all measurements but the first and those after some number are of half-size views."""

    def __init__(self, full: RemovalSweep, half: RemovalSweep, number: int) -> None:
        self._full, self._half, self._left = full, half, number + 1
        self._first = True

    def measure(self) -> tuple[F64, F64]:
        """As :meth:`RemovalSweep.measure`."""
        self._left -= 1
        if self._left < 0:
            return self._full.measure()
        effects = self._half.measure()
        if self._first:
            effects = self._full.measure()
            self._first = False
        return effects

    def remove(self, splats: Indices) -> None:
        """As :meth:`RemovalSweep.remove`."""
        self._full.remove(splats)
        self._half.remove(splats)


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


# --------------------------------------------------------------------------------------------- tables


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
            removed = _at(list(mine.values()), LOSS_LEVELS[0])
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


def print_frames(rows: Sequence[Row]) -> None:
    """Splats, tile intersections and frame rates at equal loss."""
    truth = any("loss" in r for r in rows)
    unit = "dB lost against the photographs" if truth else "dB against the uncompressed renders"
    print(f"| {unit} | order | found | kept | tile intersections a view | frames/s | against unpruned |")
    print("|---" * 7 + "|")
    for r in rows:
        unpruned = next(u for u in rows if u["level"] == r["level"] and u["method"] == "unpruned")
        found = f"{r['loss' if truth else 'psnr']:.2f}" if "psnr" in r else ""
        print(
            f"| {r['level']:g} | {r['method']} | {found} | {r['kept']:,} | {r['intersections']:,.0f} | "
            f"{r['frames_per_second']:.0f} | {r['frames_per_second'] / unpruned['frames_per_second']:.2f} |"
        )


def print_results(results: Row) -> None:
    """All tables."""
    for name, found in results["scenes"].items():
        print(f"\n## {name}: {found['splats']:,} splats, {found['train']} training and {found['test']} test views")
        print(f"\n{results['device']}")
        for part, printer in (("curves", print_curves), ("skips", print_skips), ("frames", print_frames)):
            if part in found:
                print(f"\n### {part}\n")
                printer(found[part])


# ---------------------------------------------------------------------------------------------- plots


def plot_curves(scenes: Row, key: str, label: str, path: Path) -> None:
    """The paper's figure: quality against the share removed, a panel a scene."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(scenes), figsize=(6 * len(scenes), 4.6), squeeze=False)
    for axis, (name, found) in zip(axes[0], scenes.items(), strict=True):
        rows = found["curves"]
        methods = [m for m in dict.fromkeys(r["method"] for r in rows) if ONE_ORDER not in m]
        ours = [m for m in methods if m.startswith("ours")]
        shades = pyplot.get_cmap("Blues")(np.linspace(0.4, 1, len(ours)))
        for method in methods:
            mine = sorted((100 * r["removed"], r[key]) for r in rows if r["method"] == method)
            style: Row = {"marker": ".", "linestyle": "--", "linewidth": 1}
            if method in ours:
                style = {"marker": "o", "markersize": 3.5, "color": shades[ours.index(method)]}
            axis.plot(*zip(*mine, strict=True), label=method, **style)
        axis.set_title(f"{name}, {found['splats']:,} splats")
        axis.set_xlabel("% of the splats removed")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        if key == "loss":
            axis.set_ylim(4, -0.2)
    axes[0, -1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def plot_skips(scenes: Row, device: str, path: Path) -> None:
    """Time against loss at equal count, with the Pareto front; the points are numbered."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(scenes), figsize=(7.5 * len(scenes), 5), squeeze=False)
    for axis, (name, found) in zip(axes[0], scenes.items(), strict=True):
        rows, front = found["skips"], pareto(found["skips"])
        full = rows[0]["psnr_at_equal_count"]
        points = [(r["seconds"], full - r["psnr_at_equal_count"]) for r in front]
        axis.plot(*zip(*points, strict=True), "-", color="0.6", linewidth=1, zorder=0)
        for number, r in enumerate(rows, 1):
            point = r["seconds"], full - r["psnr_at_equal_count"]
            axis.plot(*point, "o", color="C0" if r in front else "C1", markersize=4, label=f"{number}  {r['skipped']}")
            axis.annotate(str(number), point, (3, 3), textcoords="offset points", fontsize=8)
        axis.axhline(0, color="0.8", linewidth=0.8, zorder=0)
        axis.set_title(f"{name}, q = 0.5, at {rows[0]['kept']:,} splats\n{device}; Pareto front in blue", fontsize=9)
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=0.5)
        axis.set_xlabel("seconds, preparation included")
        axis.set_ylabel("dB lost against the full computation (test views)")
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1), title="skipped", title_fontsize=8)
        axis.grid(alpha=0.3, which="both")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def plot(results: Row, folder: Path) -> None:
    """All pictures that the results have the rows for."""
    import matplotlib

    matplotlib.use("Agg")
    scenes = results["scenes"]
    folder.mkdir(parents=True, exist_ok=True)
    with_curves = {n: s for n, s in scenes.items() if "curves" in s}
    with_skips = {n: s for n, s in scenes.items() if "skips" in s}
    if with_curves:
        plot_curves(with_curves, "psnr", "PSNR against the uncompressed renders (dB)", folder / "pruning_curves.png")
        if all("loss" in s["curves"][0] for s in with_curves.values()):
            plot_curves(with_curves, "loss", "dB lost against the photographs", folder / "pruning_loss.png")
    if with_skips:
        plot_skips(with_skips, results["device"], folder / "pruning_skips.png")


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
