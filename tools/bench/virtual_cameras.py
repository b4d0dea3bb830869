"""What encoding without cameras costs.

    python -m tools.bench.virtual_cameras SCENE … [options]

A SCENE is a folder with point_cloud.ply and cameras.json. Each is encoded at several qualities, once with its training
cameras and once with the cameras that :mod:`potr_cl.model.virtual_cameras` places. PSNR is the mean over the true test
views, against the uncompressed scene's renders. Bytes at equal PSNR are interpolated between the qualities, in the
logarithm of the bytes. Prints Markdown.

--quick uses views of half the size, every third test view and 8 pruning iterations: enough to compare placements on a
CPU, not for publication.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Sequence

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.virtual_cameras import place_cameras
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scaled, scene_parser

QUALITIES = (0.1, 0.3, 0.5, 0.7, 0.9)
#: Bytes are compared at the PSNR that the true cameras reach at these.
COMPARED = (0.3, 0.5, 0.7)


@dataclasses.dataclass(frozen=True)
class Point:
    """One encode."""

    q: float
    splats: int
    nbytes: int
    psnr: float
    seconds: float


def curve(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    judges: Sequence[Camera],
    wanted: Sequence[FloatArray],
    qualities: Sequence[float],
    options: EncodeOptions,
) -> list[Point]:
    """Encode at each quality and judge by the test views."""
    points = []
    for q in qualities:
        began = time.perf_counter()
        encoded = encode(scene, cameras, dataclasses.replace(options, q=q), device=device)
        seconds = time.perf_counter() - began
        got = pictures(device, decode(b"".join(encoded.pieces)), judges)
        mean = float(np.mean([psnr(a, b) for a, b in zip(wanted, got, strict=True)]))
        points.append(Point(q, len(encoded.order), encoded.nbytes, mean, seconds))
        print(f"  {points[-1]}", file=sys.stderr, flush=True)
    return points


def bytes_at(points: Sequence[Point], decibels: float) -> float:
    """Bytes at a PSNR, between the qualities; NaN beyond them."""
    ordered = sorted(points, key=lambda p: p.psnr)
    values = [p.psnr for p in ordered]
    if not values[0] <= decibels <= values[-1]:
        return math.nan
    return math.exp(float(np.interp(decibels, values, [math.log(p.nbytes) for p in ordered])))


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--qualities", nargs="+", type=float, default=QUALITIES)
    parser.add_argument("--count", type=int, help="virtual views; default as encode places")
    parser.add_argument("--size", type=int, help="of their images, in pixels; default as encode's")
    parser.add_argument("--quick", action="store_true", help="few iterations, few and small views")
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        scene, cameras = read(folder)
        true, judges = train_views(cameras), test_views(cameras)
        began = time.perf_counter()
        placed = place_cameras(scene, args.count, args.size)
        placing = time.perf_counter() - began
        options = EncodeOptions.for_preset("best")
        if args.quick:
            options = options.changed(prune={"iterations": 8})
            judges = [scaled(c, 0.5) for c in judges[::3]]
            true, placed = [scaled(c, 0.5) for c in true], [scaled(c, 0.5) for c in placed]
        wanted = pictures(device, scene, judges)
        curves = {
            name: curve(device, scene, views, judges, wanted, args.qualities, options)
            for name, views in (("true", true), ("virtual", placed))
        }
        table = results.table(
            folder.name,
            f"{folder.name}: {len(true)} true, {len(train_views(placed))} virtual views placed in {placing:.1f} s",
            Column("q", format="g"),
            *(
                Column(f"{name} {what}", unit, form)
                for name in curves
                for what, unit, form in (
                    ("splats", "", ","),
                    ("bytes", "", ","),
                    ("PSNR", "dB", ".2f"),
                    ("time", "s", ".1f"),
                )
            ),
        )
        for a, b in zip(*curves.values(), strict=True):
            table.add(a.q, *(figure for p in (a, b) for figure in (p.splats, p.nbytes, p.psnr, p.seconds)))
        table = results.table(
            f"{folder.name}_at_equal_psnr",
            f"{folder.name}: bytes with virtual cameras at the PSNR that true ones reach",
            Column("q with true cameras", format="g"),
            Column("PSNR", "dB", ".2f"),
            Column("bytes", format="+.1%"),
        )
        for p in curves["true"]:
            if p.q in COMPARED:
                virtual = bytes_at(curves["virtual"], p.psnr)
                table.add(p.q, p.psnr, None if math.isnan(virtual) else virtual / p.nbytes - 1)


if __name__ == "__main__":
    main()
