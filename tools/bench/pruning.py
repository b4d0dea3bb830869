"""Quality of pruning: PSNR on test views against the share of splats removed.

    python -m tools.bench.pruning SCENE … [--json FILE] [options]

For our schedule at several numbers of iterations (one schedule for each count of survivors) and for orders by a score:
importance Σ α T, MesonGS's Σ α T V^0.1 with V the volume, opacity, and at random. What the schedule may skip compares
tools.study.rate_distortion, a series a choice, as in --series default exact:prune.tolerance=0.

PSNR is the mean over test views against the uncompressed scene's renders; where a scene has photographs in images, what
is lost against these stands beside.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.controller import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep import SweepOptions
from tools.results import Cell, Column, Results
from tools.study.evaluation import EvaluatedScene
from tools.workloads import scene_parser

#: What is kept of the test views after each share.
Curve = list[dict[str, Any]]


def curves(
    evaluator: EvaluatedScene, rasterizer: Rasterizer, every: int, shares: Sequence[float], iterations: Sequence[int]
) -> Iterator[tuple[str, Curve]]:
    """An order, and what it keeps at each share removed."""
    scene, views = evaluator.source, train_views(evaluator.cameras)[::every]
    counts = [round(len(scene) * (1 - share)) for share in shares]
    with RemovalSweep(rasterizer, views, SweepOptions(transmittance_threshold=None)) as sweep:
        importance = sweep.measure()[1]
    # The lowest go first.
    scores = {
        "importance": importance,
        "MesonGS": importance * np.exp(scene.log_scales.sum(axis=1, dtype=np.float64)) ** 0.1,
        "opacity": scene.opacities.astype(np.float64),
        "random": np.random.default_rng(0).random(len(scene)),
    }
    for name, score in scores.items():
        order = np.argsort(score, kind="stable")
        yield name, [evaluator(scene.subset(order[len(order) - kept :])) for kept in counts]
    for rounds in iterations:
        found: Curve = []
        for kept in counts:
            with RemovalSweep(rasterizer, views, SweepOptions()) as removal:
                pruned = prune_scene(removal, PruningOptions(0, rounds, count=kept))
            found.append(evaluator(scene.subset(pruned.survivors)))
        yield f"ours, {rounds} iterations", found


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th view only")
    parser.add_argument("--removed", nargs="+", type=float, default=list(range(10, 90, 10)), help="per cent")
    parser.add_argument("--iterations", nargs="+", type=int, default=[1, 4, 8, 16, 48])
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        with ExitStack() as open_things:
            evaluator = open_things.enter_context(EvaluatedScene(folder, device, args.every))
            rasterizer = open_things.enter_context(Rasterizer(device, evaluator.source))
            truth = "psnr_loss" in evaluator(evaluator.source)
            form = "{:.1f} / {:.2f}" if truth else ".1f"
            table = results.table(
                f"curves_{evaluator.name}",
                f"PSNR{' / loss against the photographs' if truth else ''}, dB, by part removed",
                "order", *(Column(f"{share:g} %", format=form) for share in args.removed),
            )  # fmt: skip
            shares = [share / 100 for share in args.removed]
            for name, points in curves(evaluator, rasterizer, args.every, shares, args.iterations):
                cells: list[Cell] = [[p["psnr"], p["psnr_loss"]] if truth else p["psnr"] for p in points]
                table.add(name, *cells)


if __name__ == "__main__":
    main()
