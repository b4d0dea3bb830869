"""What encoding without cameras costs: python -m tools.bench.virtual_cameras SCENE … [options]

A SCENE is a folder with point_cloud.ply and cameras.json. Each is encoded at several qualities, once with its training
cameras and once with the cameras that :mod:`potr_cl.model.virtual_cameras` places. PSNR is the mean over the true test
views, against the uncompressed scene's renders. Bytes at equal PSNR are interpolated between the qualities, in the
logarithm of the bytes. Prints Markdown.

--quick uses views of half the size, every third test view and 8 pruning iterations: enough to compare placements on a
CPU, not for publication.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.virtual_cameras import place_cameras
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer

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


def scaled(camera: Camera, factor: float) -> Camera:
    """The same view at another resolution."""
    width, height = max(round(camera.width * factor), 1), max(round(camera.height * factor), 1)
    across, down = width / camera.width, height / camera.height
    return dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=camera.cx * across,
        cy=camera.cy * down,
        image_path=None,
    )


def pictures(device: Device, scene: Scene, views: Sequence[Camera]) -> list[FloatArray]:
    """Renders, clamped to [0, 1]."""
    rasterizer = Rasterizer(device, scene)
    images = [np.clip(rasterizer.render(view)[0], 0, 1) for view in views]
    rasterizer.free()
    return images


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--qualities", nargs="+", type=float, default=QUALITIES)
    parser.add_argument("--count", type=int, help="virtual views; default as encode places")
    parser.add_argument("--size", type=int, help="of their images, in pixels; default as encode's")
    parser.add_argument("--quick", action="store_true", help="few iterations, few and small views")
    parser.add_argument("--json", type=Path, help="also write the raw results here")
    parser.add_argument("--device")
    args = parser.parse_args()
    device = Device(args.device)
    raw = {}
    print(f"{device.info}\n")
    for folder in args.scenes:
        scene, cameras = load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")
        true, judges = train_views(cameras), test_views(cameras)
        began = time.perf_counter()
        placed = place_cameras(scene, args.count, args.size)
        placing = time.perf_counter() - began
        options = EncodeOptions.for_preset("best")
        if args.quick:
            options = dataclasses.replace(options, iterations=8)
            judges = [scaled(c, 0.5) for c in judges[::3]]
            true, placed = [scaled(c, 0.5) for c in true], [scaled(c, 0.5) for c in placed]
        wanted = pictures(device, scene, judges)
        curves = {
            name: curve(device, scene, views, judges, wanted, args.qualities, options)
            for name, views in (("true", true), ("virtual", placed))
        }
        raw[folder.name] = {name: [dataclasses.asdict(p) for p in points] for name, points in curves.items()}
        print(
            f"### {folder.name}: {len(true)} true, {len(train_views(placed))} virtual views placed in {placing:.1f} s"
        )
        print("\n| q | true: splats | bytes | PSNR | time | virtual: splats | bytes | PSNR | time |")
        print("|---|---|---|---|---|---|---|---|---|")
        for a, b in zip(*curves.values(), strict=True):
            cells = [f"{p.splats} | {p.nbytes} | {p.psnr:.2f} dB | {p.seconds:.1f} s" for p in (a, b)]
            print(f"| {a.q:g} | {' | '.join(cells)} |")
        for p in curves["true"]:
            if p.q in COMPARED:
                more = 100 * (bytes_at(curves["virtual"], p.psnr) / p.nbytes - 1)
                print(f"\nAt {p.psnr:.2f} dB (q = {p.q:g} with true cameras): {more:+.1f} % bytes.", flush=True)
        print()
    if args.json is not None:
        args.json.write_text(json.dumps(raw, indent=1))


if __name__ == "__main__":
    main()
