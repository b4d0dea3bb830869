"""How long does a palette of SH coefficients take, and how near does it come?

    python -m tools.bench.palettes SCENE.ply [--splats N] [--entries K] [--steps S …] [--all N] [--json OUT.json]

The scene's splats are repeated, each time a little changed, until there are N. Errors are roots of the mean squared
error of a splat's coefficients. ``--all N`` compares with clusters for which each of N splats is compared with each
entry.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl import load_scene
from potr_cl.clustering import kmeans
from potr_cl.clustering.kmeans import Rate, cluster
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from tools.results import Column, Results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splats", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--entries", type=int, default=65536, metavar="K")
    parser.add_argument("--steps", type=int, nargs="+", default=[kmeans.STEPS], metavar="S")
    parser.add_argument("--all", type=int, default=0, metavar="N", help="splats to compare with all entries; 0: none")
    parser.add_argument("--device", help="what it is called")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    device = Device(choose_device(options.device))
    points = repeated(load_scene(options.scene).sh[:, 1:], options.splats)
    weights = np.ones(points.shape[:2], np.float32)
    cluster(device, points[:2000], weights[:2000], 600, steps=1)
    results = Results(device.info, options.json)
    table = results.table(
        "palettes",
        f"Palettes of {options.entries} entries at most for {options.splats} splats of SH degree 3",
        Column("entries and labels"),
        Column("steps", format="d"),
        Column("entries", format="d"),
        Column("time", "s", ".2f"),
        Column("processor time", "s", ".2f"),
        Column("error of a splat", format=".4f"),
    )
    # In bits: such that about half of the splats are worth an entry of their own.
    dear = weights * np.float32(300)
    for steps in options.steps:
        for rate in (None, Rate(20.0)):
            table.add(
                "cost bits" if rate else "are free",
                steps,
                *measured(device, points, dear if rate else weights, options.entries, steps, rate),
            )
    if options.all:
        table = results.table(
            "comparisons",
            "Errors of clusters in two levels, and of those for which each splat is compared with each entry",
            Column("splats", format="d"),
            Column("entries", format="d"),
            Column("two levels", format=".4f"),
            Column("all", format=".4f"),
        )
        table.add(*compared(device, points[: options.all], weights[: options.all]))


def measured(
    device: Device, points: FloatArray, weights: FloatArray, entries: int, steps: int, rate: Rate | None
) -> tuple[int, float, float, float]:
    """Entries, seconds and processor seconds of one clustering, and its error."""
    began, used = time.perf_counter(), sum(os.times()[:2])
    found = cluster(device, points, weights, entries, rate, steps)
    seconds, processor = time.perf_counter() - began, sum(os.times()[:2]) - used
    return len(np.unique(found.labels)), seconds, processor, error(points, found.centres, found.labels)


def compared(device: Device, points: FloatArray, weights: FloatArray) -> tuple[int, int, float, float]:
    """Splats, entries, the error of clusters in two levels, and of those for which everything is compared."""
    entries = len(points) // 16
    two_levels = cluster(device, points, weights, entries)
    few, kmeans._FEW = kmeans._FEW, entries + 1
    try:
        everything = cluster(device, points, weights, entries)
    finally:
        kmeans._FEW = few
    first, second = (error(points, found.centres, found.labels) for found in (two_levels, everything))
    return len(points), entries, first, second


def error(points: FloatArray, centres: FloatArray, labels: NDArray[np.uint32]) -> float:
    """The root of the mean squared distance."""
    total = 0.0
    for start in range(0, len(points), 1 << 16):
        some = slice(start, start + (1 << 16))
        total += float(np.square(points[some] - centres[labels[some]], dtype=np.float64).sum())
    return float(np.sqrt(total / len(points)))


def repeated(points: FloatArray, count: int) -> FloatArray:
    """So many points; those that are repeated differ by a twentieth of their length."""
    generator = np.random.default_rng(1)
    many = points[np.arange(count) % len(points)]
    again = many[len(points) :]
    again *= 1 + generator.normal(0, 0.05, again.shape).astype(np.float32)
    return many


if __name__ == "__main__":
    main()
