"""Encoding to a size or a PSNR: python -m tools.bench.search SCENE … [--sizes B …] [--psnrs DB …] [--device D]

A SCENE is a folder with point_cloud.ply and cameras.json. For each target: what was reached, the steps, what the file
loses to a plain encode of its size, and how many times such an encode's time the search took. Both are read off curves
through plain encodes at the qualities of --qualities, which have to lie on both sides of what is reached, close by;
between them PSNR and time are interpolated in the logarithm of the size. Prints Markdown.
"""

from __future__ import annotations

import argparse
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
from potr_cl.formats import load_cameras, load_scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import Encoded, encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.search import Target, encode_to_target
from potr_cl.quality.evaluator import EvaluationViews, Evaluator


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


def _against(plain: list[_Plain], size: float, psnr: float, took: Timed) -> tuple[str, str, str]:
    """What is gained on a plain encode of a size, and the times in such encodes."""
    sizes = [each.size for each in plain]
    if not sizes or not sizes[0] <= size <= sizes[-1]:
        return "–", f"{took.clock:.1f} s", f"{took.processors:.1f} s"
    usual, clock, processors = (
        float(np.interp(size, sizes, [getattr(each, name) for each in plain]))
        for name in ("psnr", "clock", "processors")
    )
    return f"{psnr - usual:+.3f} dB", f"{took.clock / clock:.2f}", f"{took.processors / processors:.2f}"


def bench(folder: Path, device: Device, args: argparse.Namespace) -> None:
    """One scene."""
    scene, cameras = load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")
    cameras = [c for split in ("train", "test") for c in [c for c in cameras if c.split == split][:: args.every]]
    evaluator = Evaluator(device, scene, EvaluationViews.of(cameras), (0.0, 0.0, 0.0))
    options = EncodeOptions.for_preset(args.preset)
    few = [camera for camera in cameras if camera.split == "train"][:4]
    encode(scene, few, replace(options, iterations=1), device=device)  # builds the kernels

    def measured(encoded: Encoded) -> float:
        return evaluator.psnr(decode(b"".join(encoded.pieces)))

    print(
        f"\n{folder.name}, plain encodes:\n\n| quality | bytes | PSNR | time | of processors |\n|---|---|---|---|---|"
    )
    plain: list[_Plain] = []
    for q in sorted(args.qualities):
        with Timed() as took:
            encoded = encode(scene, cameras, replace(options, q=q), device=device)
        plain.append(_Plain(math.log(encoded.nbytes), measured(encoded), took.clock, took.processors))
        print(
            f"| {q:g} | {encoded.nbytes:,} | {plain[-1].psnr:.3f} dB | {took.clock:.1f} s | {took.processors:.1f} s |",
            flush=True,
        )

    print("\n| target | bytes | PSNR | against plain | quality | steps | time, in plain encodes | of processors |")
    print("|---|---|---|---|---|---|---|---|")
    targets = [Target(max_bytes=int(size)) for size in args.sizes] + [Target(min_psnr=psnr) for psnr in args.psnrs]
    for target in targets:
        try:
            with Timed() as took:
                found = encode_to_target(scene, cameras, target, options, device=device)
        except UnreachableError as error:
            print(f"| {error} | | | | | | | |", flush=True)
            continue
        psnr = measured(found.encoded)
        kinds = Counter(step.kind for step in found.tries)
        gain, clock, processors = _against(plain, math.log(found.encoded.nbytes), psnr, took)
        steps = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        print(
            f"| {target} | {found.encoded.nbytes:,} | {psnr:.3f} dB | {gain} | {found.options.q:.4f} | {steps} | "
            f"{clock} | {processors} |",
            flush=True,
        )
    evaluator.free()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.2e6, 2e6, 3e6, 5e6], help="bytes")
    parser.add_argument("--psnrs", nargs="*", type=float, default=[38, 42, 45], help="dB")
    parser.add_argument("--qualities", nargs="*", type=float, default=[0, 0.05, *(k / 10 for k in range(1, 11))])
    parser.add_argument("--preset", choices=PRESETS, default="best")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th view")
    parser.add_argument("--device")
    args = parser.parse_args()
    device = Device(args.device)
    print(f"{device.info}, preset {args.preset}")
    for folder in args.scenes:
        bench(folder, device, args)


if __name__ == "__main__":
    main()
