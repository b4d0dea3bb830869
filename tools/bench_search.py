"""Encoding to a size or a PSNR: python -m tools.bench_search SCENE … [--sizes B …] [--psnrs DB …] [--device D]

A SCENE is a folder with point_cloud.ply and cameras.json. For each target: what was reached, the steps, the times as
multiples of one encode's at quality 0.5, and what the file loses to a plain encode of its size. That is read off a
curve through plain encodes at several qualities; --qualities with nothing after it leaves it out. Prints Markdown.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.decoder import decode
from potr_cl.device import Device
from potr_cl.encoder import Encoded, encode
from potr_cl.errors import UnreachableError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.judging import Judge, JudgingViews
from potr_cl.options import EncodeOptions
from potr_cl.quantize import PRESETS
from potr_cl.search import Target, encode_to_target


class Timed:
    """Seconds that a block took: by the clock, and of all processors, which other work on them disturbs less."""

    def __enter__(self) -> Timed:
        self.clock, self.processors = -time.perf_counter(), -time.process_time()
        return self

    def __exit__(self, *_error: Any) -> None:
        self.clock += time.perf_counter()
        self.processors += time.process_time()


def bench(folder: Path, device: Device, args: argparse.Namespace) -> None:
    """One scene."""
    scene, cameras = load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")
    cameras = [c for split in ("train", "test") for c in [c for c in cameras if c.split == split][:: args.every]]
    judge = Judge(device, scene, JudgingViews.of(cameras), (0.0, 0.0, 0.0))
    options = EncodeOptions.for_preset(args.preset)
    encode(scene, cameras, replace(options, iterations=1), device=device)  # builds the kernels

    def measured(encoded: Encoded) -> float:
        return judge.psnr(decode(b"".join(encoded.pieces)))

    with Timed() as one:
        once = encode(scene, cameras, options, device=device)
    print(
        f"\n{folder.name}: quality {options.q:g}: {once.nbytes:,} bytes, {measured(once):.2f} dB, {one.clock:.1f} s, "
        f"of processors {one.processors:.1f} s\n"
    )
    sizes: list[float] = []
    psnrs: list[float] = []
    for q in args.qualities:
        plain = encode(scene, cameras, replace(options, q=q), device=device)
        sizes.append(math.log(plain.nbytes))
        psnrs.append(measured(plain))
        print(f"quality {q:g}: {plain.nbytes:,} bytes, {psnrs[-1]:.2f} dB", flush=True)

    print("\n| target | bytes | PSNR | against plain | quality | full encodes, others | time | of processors |")
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
        size = math.log(found.encoded.nbytes)
        inside = bool(sizes) and sizes[0] <= size <= sizes[-1]
        gain = f"{psnr - float(np.interp(size, sizes, psnrs)):+.2f} dB" if inside else "–"
        kinds = Counter(step.kind for step in found.tries)
        print(
            f"| {target} | {found.encoded.nbytes:,} | {psnr:.2f} dB | {gain} | {found.options.q:.4f} | "
            f"{kinds['encode']}, {kinds['estimate']} + {kinds['steps']} | {took.clock / one.clock:.2f} | "
            f"{took.processors / one.processors:.2f} |",
            flush=True,
        )
    judge.free()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.2e6, 2e6, 3e6, 5e6], help="bytes")
    parser.add_argument("--psnrs", nargs="*", type=float, default=[38, 42, 45], help="dB")
    parser.add_argument("--qualities", nargs="*", type=float, default=[0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1])
    parser.add_argument("--preset", choices=PRESETS, default=EncodeOptions.preset)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th view")
    parser.add_argument("--device")
    args = parser.parse_args()
    device = Device(args.device)
    print(f"{device.info}, preset {args.preset}")
    for folder in args.scenes:
        bench(folder, device, args)


if __name__ == "__main__":
    main()
