"""Where the bits go and what they buy.

    python -m tools.study.rates PART SCENE … [--q Q] [--reduced FOLDER]

Parts: errors (bits and error of each quantiser, and of others that were tried), margins (what a bit less of each
property costs), streams (bytes and decode time with each coder), sizes (the steps from the paper's file to the
smallest, at equal PSNR), balance (pruning and compaction against steps: a grid over both). A SCENE is a folder with
point_cloud.ply and cameras.json with test views. All but balance start from the scene as preset "paper" prunes and
compacts it, which is kept in FOLDER. Prints Markdown for docs/benchmarks.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree, quantize
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import PotrFile, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Property
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.scenes import ply
from potr_cl.model.camera import Camera, camera_centres, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.report.file import file_report
from tools.workloads import reduced

STEPS = ("sf_dc", "sf_sh", "sf_opacity", "sf_rotation", "sf_scale")
#: Steps of equal worth at q = 0.5 for colours that compaction has made sparse; a preset with a re-fit has others.
COMPACTED = {"sf_dc": 31.0, "sf_sh": 24.0, "sf_opacity": 5.5, "sf_rotation": 9.5, "sf_scale": 11.0, "beta": 0.04}


class Bench:
    """A scene, its reduced version, and the pictures to compare with."""

    def __init__(self, folder: Path, args: argparse.Namespace, device: Device) -> None:
        self.name = folder.resolve().name
        self.device = device
        self.source = load_scene(folder / "point_cloud.ply")
        cameras = load_cameras(folder / "cameras.json")
        self.train = train_views(cameras)
        views = [c for c in cameras if c.split == "test"]
        self.views = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, args.views).round().astype(int))]
        self.pictures = self.render(self.source)
        self._kept = args.reduced / f"{self.name}_{args.q:g}.ply"
        self._q = args.q

    def reduced(self) -> Scene:
        if not self._kept.exists():
            self._kept.parent.mkdir(parents=True, exist_ok=True)
            options = EncodeOptions.for_preset("paper", q=self._q)
            ply.save(self._kept, reduced(self.source, self.train, options, self.device))
        return load_scene(self._kept)

    def render(self, scene: Scene) -> list[FloatArray]:
        with Rasterizer(self.device, scene) as rasterizer:
            return [np.clip(rasterizer.render(view)[0], 0, 1) for view in self.views]

    def error(self, scene: Scene, pictures: Sequence[FloatArray] | None = None) -> float:
        """Mean squared error against the uncompressed scene's pictures, or others; geometric mean of the views."""
        errors = [
            np.mean((a.astype(np.float64) - b) ** 2)
            for a, b in zip(self.render(scene), pictures or self.pictures, strict=True)
        ]
        return float(np.exp(np.mean(np.log(np.maximum(errors, 1e-15)))))

    def coded(self, scene: Scene, parameters: HyperParameters, entropy: EntropyCoder | None = None) -> PotrFile:
        pieces = code_scene(scene, parameters, self.train, entropy=entropy or EntropyCoder()).pieces
        return open_file(b"".join(pieces))


def _db(error: float) -> float:
    return -10 * math.log10(error)


def _bits(steps: NDArray[np.integer]) -> float:
    """Order-0 entropy, bits an integer."""
    counts = np.unique(steps, return_counts=True)[1]
    return float((counts * np.log2(counts.sum() / counts)).sum() / len(steps))


def finer(parameters: HyperParameters, factor: float) -> HyperParameters:
    """All steps smaller by a factor."""
    changed = {name: getattr(parameters, name) * factor for name in STEPS}
    return replace(parameters, beta=parameters.beta / factor, **changed)


# ------------------------------------------------------------------------------------------------ errors


def _quantisers(scene: Scene, train: Sequence[Camera]) -> Iterator[tuple[str, float, Scene]]:
    """Name, bits a splat, and the scene with only that quantised."""
    imaginary, log_scales = quantize.canonical_rotations(scene.quaternions, scene.log_scales)
    scales = np.exp(log_scales.astype(np.float64))
    largest = scales.max(axis=1)
    size = float(np.median(largest))
    logits = scene.opacity_logits.astype(np.float64)
    opacity = 1 / (1 + np.exp(-logits))

    def turned(parts: NDArray[np.float64]) -> Scene:
        real = np.sqrt(np.maximum(0, 1 - (parts**2).sum(axis=1, keepdims=True)))
        quaternions = np.concatenate([real, parts], axis=1).astype(np.float32)
        return replace(scene, quaternions=quaternions, log_scales=log_scales)

    exact = turned(imaginary)

    def scaled(steps: NDArray[np.float64], back: NDArray[np.float64]) -> tuple[float, Scene]:
        return sum(_bits(s) for s in steps.T.astype(np.int64)), replace(
            exact, log_scales=np.log(back).astype(np.float32)
        )

    for per_size in (11.0, 22.0):
        steps = np.floor(0.5 + scales * per_size / size)
        yield (
            f"scale, linear, {per_size:g} steps a size",
            *scaled(steps, np.maximum(steps, 0.25) * size / per_size),
        )
    roots = np.floor(0.5 + np.sqrt(scales / size) * 22)
    yield "scale, steps of the root", *scaled(roots, (np.maximum(roots, 0.25) / 22) ** 2 * size)
    logarithms = np.round(log_scales.astype(np.float64) / 0.2)
    yield "scale, steps of 0.2 in the logarithm", *scaled(logarithms, np.exp(logarithms * 0.2))

    for name, power in (("the same for all", 0.0), ("by the root of the size", 0.5), ("by the size", 1.0)):
        factor = 60 * np.clip((largest / np.exp(np.mean(np.log(largest)))) ** power, 1 / 16, 16)[:, None]
        steps = np.floor(0.5 + imaginary * factor)
        yield f"rotation, steps {name}", sum(_bits(s) for s in steps.T.astype(np.int64)), turned(steps / factor)

    def with_opacity(steps: NDArray[np.float64], back: NDArray[np.float64]) -> tuple[float, Scene]:
        back = np.clip(back, 1e-6, 1 - 1e-7)
        return _bits(steps.astype(np.int64)), replace(
            scene, opacity_logits=np.log(back / (1 - back)).astype(np.float32)
        )

    for factor in (101.0, 50.0):
        steps = np.floor(0.5 + opacity * factor)
        yield f"opacity, {factor:g} steps, shift of 1/4", *with_opacity(steps, (steps + 0.25) / factor)
        yield f"opacity, {factor:g} steps, no shift", *with_opacity(steps, np.maximum(steps, 0.25) / factor)
    for width in (0.2, 0.4):
        steps = np.round(np.clip(logits, -8, 12) / width)
        yield f"opacity, steps of {width:g} in the logit", *with_opacity(steps, 1 / (1 + np.exp(-steps * width)))

    centres = camera_centres(train)
    nearest = np.min([np.linalg.norm(scene.means - camera_centre, axis=1) for camera_centre in centres], axis=0)
    wide = float(np.median(largest / nearest))
    for part in (0.02, 0.04):
        for name, absolute in (("centre near enough", False), ("foreseeable level", True)):
            tree, order = octree.build(scene.means, part * wide * nearest, absolute)
            found = replace(scene.subset(order), means=octree.parse(tree, len(scene)))
            streams = (tree.occupancy, tree.several, tree.leaf_levels, tree.tails)
            stored = [EntropyCoder().section(Property.TAIL, stream.tobytes())[1] for stream in streams]
            nbytes = sum(map(len, stored))
            yield f"position, {part:g} of a size, {name}", 8 * nbytes / len(scene), found


def bench_errors(bench: Bench) -> None:
    left = bench.reduced()
    own = bench.render(left)
    print(f"\n#### {bench.name}: bits and error of one quantiser alone\n")
    print("| quantiser | bits a splat (order 0; positions zstd) | error it adds |\n|---|---|---|")
    for name, bits, scene in _quantisers(left, bench.train):
        print(f"| {name} | {bits:.2f} | {_db(bench.error(scene, own)):.1f} dB |", flush=True)


# ------------------------------------------------------------------------------------------------ margins


def bench_margins(bench: Bench) -> None:
    left = bench.reduced()
    base = HyperParameters.from_quality(0.5, "best", **COMPACTED)

    def at(parameters: HyperParameters) -> tuple[int, float]:
        file = bench.coded(left, parameters)
        return file.header.file_bytes, _db(bench.error(file.scene()))

    nbytes, psnr = at(base)
    print(f"\n#### {bench.name}: one property a third coarser, from {nbytes} bytes, {psnr:.3f} dB\n")
    print("| property | bytes | PSNR | dB for a hundredth of the bytes |\n|---|---|---|---|")
    for name in (*STEPS, "beta"):
        factor = 4 / 3 if name == "beta" else 3 / 4
        fewer, lower = at(replace(base, **{name: getattr(base, name) * factor}))
        rate = (psnr - lower) / (100 * (nbytes - fewer) / nbytes)
        print(f"| {name} | {fewer - nbytes:+d} | {lower - psnr:+.3f} dB | {rate:.3f} |", flush=True)


# ------------------------------------------------------------------------------------------------ streams


def bench_streams(bench: Bench) -> None:
    left = bench.reduced()
    parameters = HyperParameters.from_quality(0.5, "best", **COMPACTED)
    coders = {"zstd 19": EntropyCoder("zstd"), "bundles": EntropyCoder()}
    files = {name: bench.coded(left, parameters, coder) for name, coder in coders.items()}
    sections = {name: file_report(file)["sections"] for name, file in files.items()}
    print(f"\n#### {bench.name}: {len(left)} splats, the same integers in two coders\n")
    print("| | zstd 19, B a splat | bundles, B a splat | |\n|---|---|---|---|")
    for section in sections["zstd 19"]:
        plain, context = (sections[name][section]["bytes"] / len(left) for name in coders)
        print(f"| {section} | {plain:.3f} | {context:.3f} | {100 * (context / plain - 1):+.1f} % |")
    plain, context = (file.header.file_bytes / len(left) for file in files.values())
    print(f"| **all** | {plain:.3f} | {context:.3f} | {100 * (context / plain - 1):+.1f} % |")
    print("\n| decode, one thread, ms | zstd 19 | bundles |\n|---|---|---|")
    calls: dict[str, Callable[[PotrFile], Any]] = {
        part: lambda file, part=part: getattr(file, part)()  # type: ignore[misc]
        for part in ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    }
    calls["all, one thread"] = lambda file: file.scene(threads=1)
    calls["all, all threads"] = lambda file: file.scene()
    for part, call in calls.items():
        print(f"| {part} | " + " | ".join(f"{1e3 * _seconds(call, file):.0f}" for file in files.values()) + " |")


def _seconds(call: Callable[[PotrFile], Any], file: PotrFile) -> float:
    times = []
    for _ in range(5):
        began = time.perf_counter()
        call(file)
        times.append(time.perf_counter() - began)
    return statistics.median(times)


# ------------------------------------------------------------------------------------------------ sizes


def bench_sizes(bench: Bench) -> None:
    """Each step's file where its PSNR is that of the paper's file, by interpolation between finer and coarser ones."""
    left = bench.reduced()
    paper = HyperParameters.from_quality(0.5)
    file = bench.coded(left, paper, EntropyCoder("zstd"))
    size, psnr = file.header.file_bytes, _db(bench.error(file.scene()))
    print(f"\n#### {bench.name}: at the PSNR of the paper's steps ({psnr:.2f} dB), {len(left)} splats\n")
    print("| | bytes | B a splat | |\n|---|---|---|---|")
    print(f"| paper's steps, zstd 19 | {size} | {size / len(left):.2f} | |")
    best = HyperParameters.from_quality(0.5, "best", **COMPACTED)
    for name, coder in (("steps of equal worth, zstd 19", "zstd"), ("the same, bundles", "bundles")):
        curve = []
        for factor in (1.0, 1.25, 1.5625, 1.953):
            file = bench.coded(left, finer(best, factor), EntropyCoder(coder))
            curve.append((_db(bench.error(file.scene())), math.log(file.header.file_bytes)))
        at, logarithm = np.array(sorted(curve)).T
        equal = math.exp(float(np.interp(psnr, at, logarithm)))
        note = f"{100 * (equal / size - 1):+.1f} %"
        print(f"| {name} | {equal:.0f} | {equal / len(left):.2f} | {note} |", flush=True)


# ------------------------------------------------------------------------------------------------ balance


def bench_balance(bench: Bench, q: float, refit_steps: int) -> None:
    """Pruning and compaction of other qualities with steps around the preset's."""
    coded = encode(bench.source, bench.train, EncodeOptions.for_preset("paper", q=q), device=bench.device)
    psnr = _db(bench.error(open_file(b"".join(coded.pieces)).scene()))
    print(f"\n#### {bench.name}: pruning and compaction against steps; paper: {coded.nbytes} bytes, {psnr:.2f} dB\n")
    print("| ΔMSE_MAX of q + | λ of q + | steps finer by | splats | bytes | PSNR |\n|---|---|---|---|---|---|")
    for more in (0.0, 0.15, 0.3):
        for softer in (0.0, 0.5, 1.0):
            options = EncodeOptions.for_preset(
                "best",
                q=q,
                prune={"delta_mse_max": 10 ** (-8.8 - 2 * (q + more))},
                compact={"lam": 10 ** -(q + softer)},
                refit={"steps": refit_steps},
            )
            left = reduced(bench.source, bench.train, options, bench.device)
            for factor in (0.7, 0.85, 1.0, 1.25):
                file = bench.coded(left, finer(options.parameters, factor))
                psnr = _db(bench.error(file.scene()))
                row = f"| {more:g} | {softer:g} | {factor:g} | {len(left)} | {file.header.file_bytes} | {psnr:.2f} dB |"
                print(row, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("errors", "margins", "streams", "sizes", "balance"))
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--q", type=float, default=0.5)
    parser.add_argument("--views", type=int, default=1000, help="test views, spread evenly; default: all")
    parser.add_argument("--reduced", type=Path, default=Path("reduced"), metavar="FOLDER")
    parser.add_argument("--refit", type=int, default=0, help="balance: steps of the re-fit")
    parser.add_argument("--device")
    args = parser.parse_args()
    device = Device(args.device)
    for folder in args.scenes:
        bench = Bench(folder, args, device)
        if args.part == "balance":
            bench_balance(bench, args.q, args.refit)
        else:
            {"errors": bench_errors, "margins": bench_margins, "streams": bench_streams, "sizes": bench_sizes}[
                args.part
            ](bench)


if __name__ == "__main__":
    main()
