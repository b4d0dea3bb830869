"""Encoding to a size or a PSNR.

    python -m tools.bench.search SCENE … [--sizes B …] [--psnrs DB …] [--device D]

A SCENE is a folder with point_cloud.ply and cameras.json. For each target: what was reached, the steps, what the file
loses to a plain encode of its size, and how many times such an encode's time the search took. Both are read off curves
through plain encodes at the qualities of --qualities, which have to lie on both sides of what is reached, close by;
between them PSNR and time are interpolated in the logarithm of the size. Prints Markdown.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import PRESETS
from potr_cl.errors import UnreachableError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.target import Target
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from tools.results import Column, Results, Table
from tools.workloads import read, scene_parser


class Timed:
    """Seconds that a block took: by the clock, and of all processors, which other work on them disturbs less."""

    def __enter__(self) -> Timed:
        self.clock, self.processors = -time.perf_counter(), -time.process_time()
        return self

    def __exit__(self, *_error: Any) -> None:
        self.clock += time.perf_counter()
        self.processors += time.process_time()


@dataclass(frozen=True)
class _Plain:
    """A plain encode: the logarithm of its bytes, decibels, seconds by the clock and of all processors."""

    size: float
    psnr: float
    clock: float
    processors: float


def _against(
    plain: list[_Plain], size: float, psnr: float, took: Timed
) -> tuple[float, float, float] | tuple[None, None, None]:
    """Decibels gained on a plain encode of a size, and the times in such encodes; None beyond the plain ones."""
    sizes = [each.size for each in plain]
    if not sizes or not sizes[0] <= size <= sizes[-1]:
        return None, None, None
    usual, clock, processors = (
        float(np.interp(size, sizes, [getattr(each, name) for each in plain]))
        for name in ("psnr", "clock", "processors")
    )
    return psnr - usual, took.clock / clock, took.processors / processors


def _halfway(a: _Plain, b: _Plain) -> tuple[Target, Target]:
    """A size (to 10 kB) and a PSNR (to 0.1 dB) between two plain encodes."""
    size = round(math.exp((a.size + b.size) / 2) / 1e4) * 10_000
    return Target(max_bytes=max(size, 10_000)), Target(min_psnr=round((a.psnr + b.psnr) / 2, 1))


@dataclass(frozen=True)
class _Tables:
    """What all scenes' rows go to."""

    plain: Table
    targets: Table


def bench(folder: Path, device: Device, tables: _Tables, args: argparse.Namespace) -> None:
    """One scene."""
    scene, cameras = read(folder)
    cameras = [c for split in ("train", "test") for c in [c for c in cameras if c.split == split][:: args.every]]
    with Evaluator(device, scene, EvaluationViews.of(cameras), (0.0, 0.0, 0.0)) as evaluator:
        options = EncodeOptions.for_preset(args.preset)
        few = [camera for camera in cameras if camera.split == "train"][:4]
        encode(scene, few, options.changed(prune={"iterations": 1}), device=device)  # builds the kernels

        def measured(encoded: Encoded) -> float:
            return evaluator.psnr(decode(b"".join(encoded.pieces)))

        plain: list[_Plain] = []
        for q in sorted(args.qualities):
            with Timed() as took:
                encoded = encode(scene, cameras, replace(options, q=q), device=device)
            plain.append(_Plain(math.log(encoded.nbytes), measured(encoded), took.clock, took.processors))
            tables.plain.add(folder.name, q, encoded.nbytes, plain[-1].psnr, took.clock, took.processors)
        targets = [Target(max_bytes=int(size)) for size in args.sizes] + [Target(min_psnr=psnr) for psnr in args.psnrs]
        if args.halfway:
            targets = [target for pair in itertools.pairwise(plain) for target in _halfway(*pair)]
        for target in targets:
            try:
                with Timed() as took:
                    found = encode_to_target(scene, cameras, target, options, device=device)
            except UnreachableError as error:
                tables.targets.add(folder.name, str(error), *[None] * 7)
                continue
            psnr = measured(found.encoded)
            kinds = Counter(step.kind for step in found.tries)
            gain, clock, processors = _against(plain, math.log(found.encoded.nbytes), psnr, took)
            steps = ", ".join(f"{count} {kind}" if count > 1 else kind for kind, count in kinds.items())
            tables.targets.add(
                folder.name, str(target), found.encoded.nbytes, psnr, gain, found.options.q, steps, clock, processors
            )


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.2e6, 2e6, 3e6, 5e6], help="bytes")
    parser.add_argument("--psnrs", nargs="*", type=float, default=[38, 42, 45], help="dB")
    parser.add_argument("--qualities", nargs="*", type=float, default=[0, 0.05, *(k / 10 for k in range(1, 11))])
    parser.add_argument(
        "--halfway", action="store_true", help="instead: a size and a PSNR between each two neighbouring qualities"
    )
    parser.add_argument("--preset", choices=PRESETS, default="best")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th view")
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    every = "all views" if args.every == 1 else f"one of {args.every} views"
    tables = _Tables(
        results.table(
            "plain",
            f"Plain encodes, preset {args.preset}, {every}",
            Column("scene"),
            Column("quality", format="g"),
            Column("bytes", format=","),
            Column("PSNR", "dB", ".2f"),
            Column("time", "s", ".1f"),
            Column("processor time", "s", ".1f"),
        ),
        results.table(
            "targets",
            f"Search to a size or a PSNR, preset {args.preset}, {every}",
            Column("scene"),
            Column("target"),
            Column("bytes reached", format=","),
            Column("PSNR reached", "dB", ".2f"),
            Column("against plain", "dB", "+.2f"),
            Column("quality", format=".3f"),
            Column("steps"),
            Column("time, in plain encodes", format=".1f"),
            Column("processor time, in plain encodes", format=".1f"),
        ),
    )
    for folder in args.scenes:
        bench(folder, device, tables, args)


if __name__ == "__main__":
    main()
