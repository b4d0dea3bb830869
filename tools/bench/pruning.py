"""Quality and cost of pruning.

    python -m tools.bench.pruning SCENE … [--part curves] [--part skips] [--json FILE] [options]

Parts (both by default):

curves  PSNR on test views against the share of splats removed, for our schedule at several numbers of iterations (one
        schedule for each count of survivors) and for orders by a score: importance Σ α T, MesonGS's Σ α T V^0.1 with
        V the volume, opacity, and at random.
skips   the schedule at q = 0.5 with everything computed, and with each of the things that it may skip or do otherwise:
        time, tiles swept, splats kept, and what that costs at equal counts. The Pareto front is marked.

PSNR is the mean over test views against the uncompressed scene's renders; where a scene has photographs in images, what
is lost against these stands beside.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import Pruned, PruningOptions
from potr_cl.stages.pruning.staleness import SweepOptions
from tools.results import Cell, Column, Results
from tools.study.evaluation import EvaluatedScene
from tools.workloads import log, scene_parser

Indices = NDArray[np.int64]
Row = dict[str, Any]

#: ΔMSE_MAX at q = 0.5.
DELTA_MSE_MAX = 10**-9.8


class Bench(Owner):
    """One scene on one device; every: only each so many-th view."""

    def __init__(self, folder: Path, device: Device, every: int = 1) -> None:
        self.device, self.evaluator = device, EvaluatedScene(folder, device, every)
        self.scene, self.train = self.evaluator.source, train_views(self.evaluator.cameras)[::every]
        self.rasterizer = Rasterizer(device, self.scene)
        # Builds every kernel, so that no measurement pays for it.
        self.pruned(self.train[:1], PruningOptions(0, 1, count=len(self.scene) // 2), SweepOptions())

    def quality(self, survivors: Indices) -> Row:
        """What the survivors keep of the test views."""
        return self.evaluator(self.scene.subset(survivors))

    def pruned(self, cameras: Sequence[Camera], options: PruningOptions, sweep: SweepOptions) -> tuple[Pruned, Row]:
        """Run a schedule; its result and its cost in seconds and full sweeps."""
        started = time.perf_counter()
        with RemovalSweep(self.rasterizer, cameras, sweep) as removal:
            prepared = time.perf_counter()
            result = prune_scene(removal, options)
            self.device.queue.finish()
            cost = {"preparing": prepared - started, "seconds": time.perf_counter() - started, "sweeps": removal.sweeps}
        return result, cost

    def scores(self) -> dict[str, NDArray[np.float64]]:
        """Other pruners' scores of each splat; those with the lowest go first."""
        with RemovalSweep(self.rasterizer, self.train, SweepOptions(transmittance_threshold=None)) as sweep:
            importance = sweep.measure()[1]
        volume = np.exp(self.scene.log_scales.sum(axis=1, dtype=np.float64))
        return {
            "importance": importance,
            "MesonGS": importance * volume**0.1,
            "opacity": self.scene.opacities.astype(np.float64),
            "random": np.random.default_rng(0).random(len(self.scene)),
        }

    def close(self) -> None:
        """Give the device's memory back."""
        self.rasterizer.close()
        self.evaluator.close()


def curves(bench: Bench, shares: Sequence[float], iterations: Sequence[int]) -> Iterator[tuple[str, list[Row]]]:
    """A method, and what it keeps at each share removed."""
    counts = [round(len(bench.scene) * (1 - share)) for share in shares]
    for name, score in bench.scores().items():
        order = np.argsort(score, kind="stable")
        yield name, [bench.quality(order[len(order) - kept :]) for kept in counts]
    for rounds in iterations:
        results = (bench.pruned(bench.train, PruningOptions(0, rounds, count=kept), SweepOptions()) for kept in counts)
        yield f"ours, {rounds} iterations", [bench.quality(result.survivors) for result, _ in results]


@dataclasses.dataclass(frozen=True)
class Setting:
    """One row of the skips: its name, iterations, what measurements skip, every so many-th view, other options."""

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
    return settings + [Setting(f"every {name} view", most, every=n) for name, n in (("2nd", 2), ("4th", 4))]


def skips(bench: Bench, iterations: Sequence[int]) -> list[Row]:
    """One row a setting. Equal counts: each order is cut where the full computation ended."""
    rows: list[Row] = []
    for setting in skip_settings(iterations):
        options = PruningOptions(DELTA_MSE_MAX, setting.iterations, **setting.pruning)
        views = bench.train[:: setting.every]
        result, cost = bench.pruned(views, options, setting.sweep)
        cost["sweeps"] *= len(views) / len(bench.train)
        kept = rows[0]["kept"] if rows else result.kept
        equal = bench.quality(result.order[len(result.order) - kept :])["psnr"]
        quality = bench.quality(result.survivors)
        rows.append({"skipped": setting.name, "kept": result.kept, **quality, "equal": equal, **cost})
        log(f"{bench.evaluator.name}: skipping {setting.name}: {cost['seconds']:.1f} s, {equal:.2f} dB")
    return rows


def pareto(rows: Sequence[Row]) -> list[Row]:
    """The rows that no other beats in both time and PSNR at equal count, by ascending time."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda r: (r["seconds"], -r["equal"])):
        if not front or row["equal"] > front[-1]["equal"]:
            front.append(row)
    return front


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--part", action="append", choices=("curves", "skips"), dest="parts")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th view only")
    parser.add_argument("--removed", nargs="+", type=float, default=list(range(10, 90, 10)), help="per cent")
    parser.add_argument("--iterations", nargs="+", type=int, default=[1, 4, 8, 16, 48])
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        with Bench(folder, device, args.every) as bench:
            name = bench.evaluator.name
            if not args.parts or "curves" in args.parts:
                truth = "psnr_loss" in bench.evaluator(bench.scene)
                form = "{:.1f} / {:.2f}" if truth else ".1f"
                table = results.table(
                    f"curves_{name}", f"PSNR{' / loss against the photographs' if truth else ''}, dB, by part removed",
                    "order", *(Column(f"{share:g} %", format=form) for share in args.removed),
                )  # fmt: skip
                for method, points in curves(bench, [share / 100 for share in args.removed], args.iterations):
                    cells: list[Cell] = [[p["psnr"], p["psnr_loss"]] if truth else p["psnr"] for p in points]
                    table.add(method, *cells)
            if not args.parts or "skips" in args.parts:
                table = results.table(
                    f"skips_{name}", f"What the schedule may skip: {name}, q = 0.5",
                    "skipped; time|s|.2f; of it preparing|s|.2f; full sweeps||.1f; kept||,; PSNR|dB|.2f; "
                    "lost on the photographs|dB|.3f; at equal count|dB|.2f; against the full computation|dB|+.2f; "
                    "Pareto front",
                )  # fmt: skip
                rows = skips(bench, args.iterations)
                front = pareto(rows)
                for r in rows:
                    table.add(
                        r["skipped"], r["seconds"], r["preparing"], r["sweeps"], r["kept"], r["psnr"],
                        r.get("psnr_loss"), r["equal"], r["equal"] - rows[0]["equal"], "yes" if r in front else "",
                    )  # fmt: skip


if __name__ == "__main__":
    main()
