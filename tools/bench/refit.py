"""What the joint re-fit of the colours brings and takes.

    python -m tools.bench.refit measure SCENE … --json OUT.json [--removed PART …] [--drops X …] [options]
    python -m tools.bench.refit report OUT.json [--images DIR]

A SCENE is a folder with point_cloud.ply, cameras.json with test views and, if it has any, photographs in images.
``measure`` looks at

curves   bytes and PSNR after removing a part of the splats, for each way to treat the colours of those that are left
         (WAYS); every re-fit is on the geometry and the opacities that a decoder sees
steps    squared error on training views and PSNR on test views after 0 to 32 conjugate-gradient steps
cuts     the same number of steps, with a new look at which colours are cut at 0 more or less often
times    a step's time against a removal sweep's over the same views

``--every N`` looks at every N-th view only, for machines that are slow. ``report`` prints Markdown and draws
DIR/refit_SCENE.png from such a file.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import active_coefficients
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.refitting.targets import GroundTruthTargets, RenderedTargets, Targets
from tools.results import circumstances, write_json
from tools.study.rate_distortion import size_at
from tools.workloads import reduced, study_parser

#: By name: whether splat by splat (the paper's compaction) comes first, and how the re-fit is done, if at all.
WAYS = {
    "as they were": (False, None),
    "splat by splat": (True, None),
    "joint": (False, "lambda"),
    "splat by splat, then joint": (True, "active"),
    "splat by splat, then joint, to photographs": (True, "ground_truth"),
}
PAPER = "splat by splat"
REMOVED = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
DROPS = (1e-11, 1e-10, 1e-9)
STEPS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
#: Where in the schedule the parts on steps, cuts and times look.
PART = 0.5
CODER = EntropyCoder("zstd", 9)


def log(text: str) -> None:
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


class Bench(Owner):
    """One scene on one device."""

    def __init__(self, folder: Path, device: Device, options: EncodeOptions, refit: RefitOptions, every: int) -> None:
        self.name, self.device, self.options, self.refit = folder.resolve().name, device, options, refit
        self.scene = load_scene(folder / "point_cloud.ply")
        cameras = load_cameras(folder / "cameras.json")
        self.train, self.test = train_views(cameras)[::every], test_views(cameras)[::every]
        self.rasterizer = Rasterizer(device, self.scene)
        self.renders = [self.rasterizer.render(c)[0] for c in self.test]
        self.ground_truth: GroundTruth | None = None
        self.truths: list[FloatArray] = []
        if (folder / "images").is_dir():
            self.ground_truth = GroundTruth(folder / "images", [*self.train, *self.test])
            self.truths = [self.ground_truth.picture(c) for c in self.test]
        self.targets = RenderedTargets(self.rasterizer, self.train)

    def close(self) -> None:
        """Give the device's memory back."""
        self.rasterizer.close()

    def evaluator(self, candidate: Scene) -> dict[str, float]:
        """Means over the test views."""
        with Rasterizer(self.device, candidate) as rasterizer:
            images = [rasterizer.render(c)[0] for c in self.test]
        values = [psnr(a, b) for a, b in zip(images, self.renders, strict=True)]
        finite = [v for v in values if math.isfinite(v)]
        figures = {"psnr": float(np.mean(finite))} if finite else {}
        if self.truths:
            figures["truth_psnr"] = float(np.mean([psnr(a, b) for a, b in zip(images, self.truths, strict=True)]))
        return figures

    def reduced(self, removed: float, compact: bool) -> Scene:
        count = max(round((1 - removed) * len(self.scene)), 1)
        return reduced(
            self.scene, self.train, self.options.changed(prune={"count": count}, compact=compact), self.device
        )

    def decoded(self, scene: Scene) -> tuple[int, Scene, NDArray[np.int64]]:
        """Bytes, the decoded scene, and the number in ``scene`` of each of its splats."""
        coded = code_scene(scene, self.options.parameters, self.train, entropy=CODER)
        return coded.nbytes, decode(b"".join(coded.pieces)), coded.order

    def on_decoded_geometry(self, scene: Scene) -> Scene:
        """The scene's colours on the geometry and the opacities that a decoder sees."""
        _, decoded, order = self.decoded(dataclasses.replace(scene, sh=scene.sh[:, :1]))
        place = np.empty(len(scene), np.int64)
        place[order] = np.arange(len(scene))
        return dataclasses.replace(decoded.subset(place), sh=scene.sh)

    def active(self, scene: Scene) -> NDArray[np.bool_]:
        return active_coefficients(scene.sh, self.options.parameters.sf_sh)

    # -------------------------------------------------------------------------------------- curves

    def point(self, scene: Scene, removed: float) -> dict[str, Any]:
        """What coding a reduced scene takes, and what is left of it."""
        nbytes, decoded, _ = self.decoded(scene)
        sparsity = ac_sparsity(scene.sh, self.options.parameters.sf_sh)
        return {
            "removed": removed,
            "splats": len(scene),
            "bytes": nbytes,
            "sparsity": sparsity,
            **self.evaluator(decoded),
        }

    def refitted(
        self, scene: Scene, targets: Targets, options: RefitOptions, active: NDArray[np.bool_] | None
    ) -> tuple[Scene, dict[str, Any]]:
        began = time.perf_counter()
        with ColourRefit(self.device, self.on_decoded_geometry(scene), self.train) as refit:
            result = refit.solve(scene.sh, targets, options, active)
        facts = {"steps": result.steps, "errors": result.errors, "seconds": time.perf_counter() - began}
        return dataclasses.replace(scene, sh=result.sh), facts

    def curves(self, removed: tuple[float, ...], drops: tuple[float, ...], note: Callable[[Any], None]) -> None:
        curves: dict[str, list[dict[str, Any]]] = {name: [] for name in WAYS}
        curves |= {f"joint, drop {drop:g}": [] for drop in drops}
        lam = self.options.parameters.lam
        for part in removed:
            scenes = {compact: self.reduced(part, compact) for compact in (False, True)}

            def add(name: str, scene: Scene, facts: dict[str, Any], part: float = part) -> None:
                curves[name].append({**self.point(scene, part), **facts})
                p = curves[name][-1]
                log(f"{self.name} {part:.0%} removed, {name}: {p['bytes']} bytes, {p.get('psnr', math.inf):.2f} dB")

            for name, (compact, how) in WAYS.items():
                scene = scenes[compact]
                facts: dict[str, Any] = {}
                targets: Targets = self.targets
                if how == "ground_truth":
                    if self.ground_truth is None:
                        continue
                    targets = GroundTruthTargets(self.device, self.ground_truth, self.train)
                if how is not None:
                    options = dataclasses.replace(self.refit, lam=lam) if how == "lambda" else self.refit
                    active = self.active(scene) if compact else None
                    scene, facts = self.refitted(scene, targets, options, active)
                add(name, scene, facts)
            for drop in drops:
                options = dataclasses.replace(self.refit, drop=drop)
                add(f"joint, drop {drop:g}", *self.refitted(scenes[False], self.targets, options, None))
            note({name: curve for name, curve in curves.items() if curve})

    # -------------------------------------------------------------------------------------- the solver

    def options_of(self, steps: int) -> RefitOptions:
        """So many steps, however little they gain."""
        return dataclasses.replace(self.refit, gain=0, steps=steps)

    def steps(self, scene: Scene, most: int) -> list[dict[str, Any]]:
        """Errors after so many steps, before the quantiser."""
        active, rows = self.active(scene), []
        with ColourRefit(self.device, scene, self.train) as refit:
            for steps in (s for s in STEPS if s <= most):
                result = refit.solve(scene.sh, self.targets, self.options_of(steps), active)
                rows.append(self._row(scene, result.sh, result.errors[1], steps=result.steps))
                log(f"{self.name} {rows[-1]}")
        return rows

    def cuts(self, scene: Scene, most: int) -> list[dict[str, Any]]:
        """The same number of steps in runs of different lengths: each run begins with a new linearisation."""
        active, rows = self.active(scene), []
        with ColourRefit(self.device, scene, self.train) as refit:
            for runs in (1, 2, 4, 8):
                options, sh = self.options_of(max(most // runs, 1)), scene.sh
                for _ in range(runs):
                    result = refit.solve(sh, self.targets, options, active)
                    sh = result.sh
                rows.append(self._row(scene, sh, result.errors[1], runs=runs, steps=options.steps))
                log(f"{self.name} {rows[-1]}")
        return rows

    def _row(self, scene: Scene, sh: FloatArray, error: float, **facts: Any) -> dict[str, Any]:
        return {**facts, "train_error": error, **self.evaluator(dataclasses.replace(scene, sh=sh))}

    def times(self, scene: Scene) -> dict[str, float]:
        """Seconds of a step and of a removal sweep of every tile; the shortest of three."""
        with (
            Rasterizer(self.device, scene) as rasterizer,
            RemovalSweep(rasterizer, self.train, SweepOptions(tolerance=-1)) as removal,
        ):
            removal.measure()
            sweeps = [_seconds(removal.measure) for _ in range(3)]
        began = time.perf_counter()
        with ColourRefit(self.device, scene, self.train) as refit:
            prepared = time.perf_counter() - began
            active, solves = self.active(scene), {}
            for steps in (2, 6):
                solve = functools.partial(refit.solve, scene.sh, self.targets, self.options_of(steps), active)
                solves[steps] = min(_seconds(solve) for _ in range(3))
        step = (solves[6] - solves[2]) / 4
        return {
            "sweep": min(sweeps),
            "step": step,
            "ratio": step / min(sweeps),
            "prepare": prepared,
            "solve_6": solves[6],
        }


def _seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _measure(args: argparse.Namespace) -> None:
    device = Device(args.device)
    options = EncodeOptions.for_preset(args.preset, q=args.quality, prune={"iterations": args.iterations})
    refit = RefitOptions(steps=args.steps, prior=args.prior)
    results: dict[str, Any] = {
        **circumstances(device.info), "device": device.info.name, "q": args.quality, "preset": args.preset,
        "steps": args.steps, "prior": args.prior, "every": args.every, "scenes": {},
    }  # fmt: skip
    for folder in args.scenes:
        with Bench(folder, device, options, refit, args.every) as bench:
            entry: dict[str, Any] = {
                "splats": len(bench.scene),
                "train_views": len(bench.train),
                "test_views": len(bench.test),
                "uncompressed": bench.evaluator(bench.scene),
            }
            results["scenes"][bench.name] = entry

            def note(curves: Any, entry: dict[str, Any] = entry) -> None:
                entry["curves"] = curves
                write_json(args.json, results)

            scene = bench.on_decoded_geometry(bench.reduced(PART, True))
            entry["times"] = bench.times(scene)
            entry["step_rows"] = bench.steps(scene, args.most_steps)
            entry["cut_rows"] = bench.cuts(scene, args.most_steps)
            write_json(args.json, results)
            bench.curves(tuple(args.removed), tuple(args.drops), note)


# ------------------------------------------------------------------------------------------------ report


def _smaller(curves: dict[str, Any], name: str, key: str) -> str:
    """How many bytes less than the paper's way a way takes at equal PSNR: the mean over its points within both."""
    parts = []
    for p in curves[name]:
        paper = size_at(curves[PAPER], key, p[key])
        if paper is not None:
            parts.append(p["bytes"] / paper - 1)
    return f"{100 * float(np.mean(parts)):+.0f} % ({len(parts)} points)" if parts else ""


def _report(args: argparse.Namespace) -> None:
    results = json.loads(args.results.read_text())
    for name, entry in results["scenes"].items():
        if "curves" not in entry:
            continue
        curves, ground_truth = entry["curves"], "truth_psnr" in entry["uncompressed"]
        keys = ["psnr", "truth_psnr"] if ground_truth else ["psnr"]
        print(
            f"### {name}: {entry['splats']:,} splats, {entry['train_views']} training and {entry['test_views']} test "
            f"views, preset {results['preset']}, q = {results['q']:g}, up to {results['steps']} steps, prior "
            f"{results['prior']:g}, on {results['device']}\n"
        )
        print("Bytes against the paper's way at equal PSNR:\n")
        heads = ["against uncompressed", "against photographs"][: len(keys)]
        print("| colours | " + " | ".join(heads) + " |\n|---|" + "---|" * len(keys))
        for way in curves:
            if way != PAPER:
                print(f"| {way} | " + " | ".join(_smaller(curves, way, key) for key in keys) + " |")
        print("\n| removed | colours | MB | AC zeros | " + " | ".join(f"PSNR {h}" for h in heads) + " |")
        print("|---|---|---|---|" + "---|" * len(keys))
        for number, part in enumerate(p["removed"] for p in curves[PAPER]):
            for way, points in curves.items():
                p = points[number]
                cells = " | ".join(f"{p[key]:.2f} dB" for key in keys)
                print(f"| {part:.0%} | {way} | {p['bytes'] / 1e6:.3f} | {p['sparsity']:.1%} | {cells} |")
        if ground_truth:
            print(f"\nUncompressed against the photographs: {entry['uncompressed']['truth_psnr']:.2f} dB.")
        print(f"\n{PART:.0%} removed, {PAPER}, then joint, before the quantiser of the colours:\n")
        print("| steps | mean squared error, training views | PSNR, test views |\n|---|---|---|")
        for row in entry["step_rows"]:
            print(f"| {row['steps']} | {row['train_error']:.3e} | {row['psnr']:.2f} dB |")
        print("\n| runs, each with a new look at the cuts | mean squared error | PSNR, test views |\n|---|---|---|")
        for row in entry["cut_rows"]:
            print(f"| {row['runs']} × {row['steps']} steps | {row['train_error']:.3e} | {row['psnr']:.2f} dB |")
        t = entry["times"]
        print(
            f"\nA step {1e3 * t['step']:.1f} ms, a removal sweep {1e3 * t['sweep']:.1f} ms: {t['ratio']:.2f} times. "
            f"Views prepared in {t['prepare']:.2f} s, six steps with all before and after {t['solve_6']:.2f} s.\n"
        )
        if args.images is not None:
            _plot(name, entry, keys, args.images / f"refit_{name}.png")


def _plot(name: str, entry: dict[str, Any], keys: list[str], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(keys), figsize=(6.4 * len(keys), 4.8), squeeze=False)
    titles = {"psnr": "PSNR against the uncompressed renders, dB", "truth_psnr": "PSNR against the photographs, dB"}
    for axis, key in zip(axes[0], keys, strict=True):
        for way, points in entry["curves"].items():
            axis.plot([p["bytes"] / 1e6 for p in points], [p[key] for p in points], marker="o", ms=4, label=way)
        if key in entry["uncompressed"]:
            axis.axhline(entry["uncompressed"][key], color="0.6", lw=1, ls="--", label="uncompressed")
        axis.set_xscale("log")
        axis.set_xlabel("MB")
        axis.set_ylabel(titles[key])
        axis.grid(alpha=0.3)
    axes[0][-1].legend(loc="lower right", fontsize="small")
    parts = [p["removed"] for p in entry["curves"][PAPER]]
    figure.suptitle(f"{name}: {min(parts):.0%} to {max(parts):.0%} of {entry['splats']:,} splats removed")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser, measure, report = study_parser(__doc__, _measure, _report)
    measure.add_argument("--removed", nargs="+", type=float, default=REMOVED, help="parts of the splats")
    measure.add_argument("--drops", nargs="*", type=float, default=DROPS, help="mean squared errors a coefficient")
    measure.add_argument("--quality", type=float, default=0.5)
    measure.add_argument("--preset", default="paper")
    measure.add_argument("--iterations", type=int, default=48, help="of pruning")
    measure.add_argument("--steps", type=int, default=RefitOptions.steps, help="of the curves' re-fits")
    measure.add_argument("--prior", type=float, default=RefitOptions.prior)
    measure.add_argument("--most-steps", type=int, default=max(STEPS), help="of the parts steps and cuts")
    measure.add_argument("--every", type=int, default=1, help="look at every N-th view only")
    report.add_argument("--images", type=Path)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
