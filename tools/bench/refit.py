"""What the joint re-fit of the colours brings and takes.

    python -m tools.bench.refit SCENE … [--removed PART …] [--drops X …] [--json FILE] [options]

A SCENE has test views and, if it has any, photographs in images. Bytes and PSNR of encodes that remove a part of the
splats, for each way to treat the colours of those that are left (:func:`ways`). Then bytes against those of the paper's
way at equal PSNR, by interpolation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.refitting.refit_options import RefitOptions
from tools.results import Cell, Results
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import size_at
from tools.workloads import log, scene_parser

PAPER = "splat by splat"


def ways(steps: int, drops: list[float], images: Path) -> dict[str, dict[str, Any]]:
    """By name: changes to options; what is left of coefficients splat by splat is chosen for the re-fit."""
    joint: dict[str, Any] = {"on": True, "steps": steps, "drop": 0.0}
    found: dict[str, dict[str, Any]] = {
        "as they were": {"compact": False, "refit": False},
        PAPER: {"compact": True, "refit": False},
        "joint": {"compact": False, "refit": joint},
        f"{PAPER}, then joint": {"compact": True, "refit": joint},
    }
    if images.is_dir():
        found[f"{PAPER}, then joint, to photographs"] = {"compact": True, "refit": {**joint, "ground_truth": images}}
    return found | {f"joint, drop {drop:g}": {"compact": False, "refit": {**joint, "drop": drop}} for drop in drops}


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
    parser.add_argument("--every", type=int, default=1, help="look at every N-th view only")
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        with EvaluatedScene(folder, device, args.every) as evaluator:
            scene, views = evaluator.source, train_views(evaluator.cameras)[:: args.every]
            table = results.table(
                f"curves_{evaluator.name}", f"Colours of what is left: {evaluator.name}, q = {args.quality:g}",
                "removed||.0%; colours; size|MB|.3f; AC zeros||.1%; PSNR against uncompressed|dB|.2f; "
                "PSNR against photographs|dB|.2f; colours|s|.1f",
            )  # fmt: skip
            curves: dict[str, list[Any]] = {}
            for part in args.removed:
                prune = {"iterations": args.iterations, "count": max(round((1 - part) * len(scene)), 1)}
                for name, changes in ways(args.steps, args.drops, folder / "images").items():
                    options = EncodeOptions.for_preset(args.preset, q=args.quality, prune=prune, **changes)
                    encoded = encode(scene, views, options, device=device)
                    left = decode(encoded.data)
                    point = {"bytes": encoded.nbytes, **evaluator(left)}
                    curves.setdefault(name, []).append(point)
                    seconds = sum(encoded.seconds.get(stage, 0.0) for stage in ("compact", "refit"))
                    zeros = ac_sparsity(left.sh, options.parameters.sf_sh)
                    quality = point["psnr"], point.get("truth_psnr")
                    table.add(part, name, encoded.nbytes / 1e6, zeros, *quality, seconds)
                    log(f"{evaluator.name} {part:.0%} removed, {name}: {encoded.nbytes} bytes, {point['psnr']} dB")
            table = results.table(
                f"smaller_{evaluator.name}", f"Bytes against the paper's way at equal PSNR: {evaluator.name}",
                "colours; against uncompressed|%|+.1f; against photographs|%|+.1f",
            )  # fmt: skip
            for name, points in curves.items():
                table.add(name, *(smaller(points, curves[PAPER], key) for key in ("psnr", "truth_psnr")))


if __name__ == "__main__":
    main()
