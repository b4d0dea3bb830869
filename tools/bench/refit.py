"""What the joint re-fit of the colours brings and takes.

    python -m tools.bench.refit SCENE … [--removed PART …] [--drops X …] [--json FILE] [options]

A SCENE has test views and, if it has any, photographs in images. Bytes and PSNR after removing a part of the splats,
for each way to treat the colours of those that are left (WAYS); every re-fit is on the geometry and the opacities that
a decoder sees. Then bytes against those of the paper's way at equal PSNR, by interpolation.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.model.camera import train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import active_coefficients
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.views.targets import PhotographTargets, RenderedTargets, Targets
from tools.results import Cell, Results
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import size_at
from tools.workloads import log, reduced, scene_parser

#: By name: whether splat by splat (the paper's compaction) comes first, and how the re-fit is done, if at all.
WAYS = {
    "as they were": (False, None),
    "splat by splat": (True, None),
    "joint": (False, "lambda"),
    "splat by splat, then joint": (True, "active"),
    "splat by splat, then joint, to photographs": (True, "ground_truth"),
}
PAPER = "splat by splat"
CODER = EntropyCoder("zstd", 9)


class Bench:
    """One scene on one device."""

    def __init__(self, folder: Path, evaluator: EvaluatedScene, device: Device, rasterizer: Rasterizer, every: int):
        self.evaluator, self.device = evaluator, device
        self.train = train_views(evaluator.cameras)[::every]
        self.targets: dict[str, Targets] = {"": RenderedTargets(rasterizer, self.train)}
        if (folder / "images").is_dir():
            truth = GroundTruth(folder / "images", self.train)
            self.targets["ground_truth"] = PhotographTargets(device, truth, self.train)

    def refitted(
        self, scene: Scene, options: EncodeOptions, refit: RefitOptions, how: str, chosen: bool
    ) -> tuple[Scene, float]:
        """Colours re-fitted on what a decoder sees, and seconds; chosen: the coefficients that are left stay."""
        began = time.perf_counter()
        coded = code_scene(
            dataclasses.replace(scene, sh=scene.sh[:, :1]), options.parameters, self.train, entropy=CODER
        )
        place = np.empty(len(scene), np.int64)
        place[coded.order] = np.arange(len(scene))
        geometry = dataclasses.replace(decode(b"".join(coded.pieces)).subset(place), sh=scene.sh)
        active = active_coefficients(scene.sh, options.parameters.sf_sh) if chosen else None
        with ColourRefit(self.device, geometry, self.train) as solver:
            solved = solver.solve(scene.sh, self.targets.get(how, self.targets[""]), refit, active)
        return dataclasses.replace(scene, sh=solved.sh), time.perf_counter() - began

    def points(self, part: float, options: EncodeOptions, refit: RefitOptions, drops: list[float]) -> dict[str, Any]:
        """By way: what coding the scene takes without a part of its splats, and what is left of it."""
        count = max(round((1 - part) * len(self.evaluator.source)), 1)
        scenes = {}
        for compact in (False, True):
            changed = options.changed(prune={"count": count}, compact=compact)
            scenes[compact] = reduced(self.evaluator.source, self.train, changed, self.device).scene
        jobs = {
            name: (compact, how, dataclasses.replace(refit, lam=options.parameters.lam) if how == "lambda" else refit)
            for name, (compact, how) in WAYS.items()
            if how != "ground_truth" or how in self.targets
        }
        jobs |= {f"joint, drop {drop:g}": (False, "", dataclasses.replace(refit, drop=drop)) for drop in drops}
        found = {}
        for name, (compact, how, chosen) in jobs.items():
            scene, seconds = scenes[compact], 0.0
            if how is not None:
                scene, seconds = self.refitted(scene, options, chosen, how, compact)
            coded = code_scene(scene, options.parameters, self.train, entropy=CODER)
            figures = self.evaluator(decode(b"".join(coded.pieces)))
            zeros = ac_sparsity(scene.sh, options.parameters.sf_sh)
            found[name] = {"bytes": coded.nbytes, "zeros": zeros, "seconds": seconds, **figures}
            log(f"{self.evaluator.name} {part:.0%} removed, {name}: {coded.nbytes} bytes, {figures['psnr']} dB")
        return found


def smaller(points: list[Any], paper: list[Any], key: str) -> Cell:
    """Bytes against the paper's way at equal quality, per cent: the mean over the points within both."""
    if any(p.get(key) is None for p in [*points, *paper]):
        return None
    at = [(p["bytes"], size_at(paper, key, p[key])) for p in points]
    parts = [100 * (size / usual - 1) for size, usual in at if usual is not None]
    return float(np.mean(parts)) if parts else None


def main() -> None:
    parser = scene_parser(__doc__)
    parts = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    parser.add_argument("--removed", nargs="+", type=float, default=parts, help="parts of the splats")
    parser.add_argument("--drops", nargs="*", type=float, default=(1e-11, 1e-10, 1e-9), help="errors a coefficient")
    parser.add_argument("--quality", type=float, default=0.5)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--iterations", type=int, default=48, help="of pruning")
    parser.add_argument("--steps", type=int, default=RefitOptions.steps, help="of the re-fits")
    parser.add_argument("--prior", type=float, default=RefitOptions.prior)
    parser.add_argument("--every", type=int, default=1, help="look at every N-th view only")
    args = parser.parse_args()
    device = Device(args.device)
    options = EncodeOptions.for_preset(args.preset, q=args.quality, prune={"iterations": args.iterations})
    refit = RefitOptions(steps=args.steps, prior=args.prior)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        with (
            EvaluatedScene(folder, device, args.every) as evaluator,
            Rasterizer(device, evaluator.source) as rasterizer,
        ):
            bench = Bench(folder, evaluator, device, rasterizer, args.every)
            table = results.table(
                f"curves_{evaluator.name}", f"Colours of what is left: {evaluator.name}, q = {args.quality:g}",
                "removed||.0%; colours; size|MB|.3f; AC zeros||.1%; PSNR against uncompressed|dB|.2f; "
                "PSNR against photographs|dB|.2f; re-fit|s|.1f",
            )  # fmt: skip
            curves: dict[str, list[Any]] = {}
            for part in args.removed:
                for name, p in bench.points(part, options, refit, args.drops).items():
                    curves.setdefault(name, []).append(p)
                    row = p["bytes"] / 1e6, p["zeros"], p["psnr"], p.get("truth_psnr"), p["seconds"]
                    table.add(part, name, *row)
            table = results.table(
                f"smaller_{evaluator.name}", f"Bytes against the paper's way at equal PSNR: {evaluator.name}",
                "colours; against uncompressed|%|+.1f; against photographs|%|+.1f",
            )  # fmt: skip
            for name, points in curves.items():
                table.add(name, *(smaller(points, curves[PAPER], key) for key in ("psnr", "truth_psnr")))


if __name__ == "__main__":
    main()
