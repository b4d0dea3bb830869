"""Run time against error: each knob that trades one for the other, turned alone, in whole encodes.

    python -m tools.study.time_error SCENE … [--device NAME] [--knobs NAME …] [--few N --scale X] [--json FILE]

Error is the bytes that a file takes more or fewer than one of its preset's defaults with the same PSNR on the test
views, in percent, the mean of two qualities; what the defaults take there is read off their own curve. Time is that of
an encode, without judging, in that of the defaults (of two, before and after the others, the faster one): by the clock
on a GPU, by the processor's time on a CPU, which others may use. Some encodes with each preset come before those that
are measured.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from potr_cl.codec.decoder import open_file
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.pipeline.encode import encode
from tools.results import Results
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import encode_options, size_at
from tools.workloads import scene_parser

#: What is turned, by name: the preset, the option, and its values.
KNOBS: dict[str, tuple[str, str, tuple[Any, ...]]] = {
    "pruning iterations": ("best", "prune.iterations", (12, 24, 32, 96)),
    "part of a tile that may be gone before it is measured again": ("best", "prune.tolerance", (0.0, 0.01, 0.04, 0.08)),
    "views between, for each given one": ("best", "between.views", (0, 0.25, 1)),
    "steps of the re-fit": ("best", "refit.steps", (2, 4, 6, 12, 16)),
    "re-fits while pruning": ("best", "refit.at", ((0.5,), (0.5, 0.75))),
    "smallest: steps of the fit": ("smallest", "fit.steps", (400, 700, 1500, 3200)),
    "smallest: views in a step of the fit": ("smallest", "fit.batch", (1, 4)),
    "smallest: views between of the fit, for each given one": ("smallest", "fit.between", (0.5, 1.0)),
    "smallest: re-fits while pruning": ("smallest", "refit.at", ((), (0.5, 0.75))),
    "fast: pruning iterations": ("fast", "prune.iterations", (8, 24, 32)),
    "fast: part of a tile that may be gone before it is measured again": ("fast", "prune.tolerance", (0.0, 0.04)),
    "fast: views between, for each given one": ("fast", "between.views", (0, 1)),
    "fast: steps of the re-fit": ("fast", "refit.steps", (2, 6, 12)),
    "paper: pruning iterations": ("paper", "prune.iterations", (12, 24, 96)),
    "paper: part of a tile that may be gone before it is measured again": (
        "paper",
        "prune.tolerance",
        (0.0, 0.02, 0.04),
    ),
    "paper: two passes of the compaction": ("paper", "compact.two_pass", (False,)),
    "paper: level of zstd": ("paper", "code.zstd_level", (3, 22)),
}
#: The qualities in which knobs are turned, and the others of the defaults' curve.
QUALITIES, AROUND = (0.3, 0.5), (0.2, 0.25, 0.35, 0.4, 0.45, 0.55)
#: Encodes of a preset before any is measured: the first ones take longer.
_WARM = 3


Point = dict[str, float]


def encoded(evaluator: EvaluatedScene, device: Device, preset: str, q: float, changes: dict[str, Any]) -> Point:
    """Seconds, bytes and PSNR of an encode."""
    options = encode_options({"preset": preset, "q": q, **changes})
    clock = time.process_time if device.info.family == "cpu" else time.perf_counter
    began = clock()
    made = encode(evaluator.source, evaluator.cameras, options, device=device)
    seconds = clock() - began
    psnr = evaluator(open_file(b"".join(made.pieces)).scene())["psnr"]
    return {"seconds": seconds, "bytes": made.nbytes, "psnr": float(psnr or np.inf)}


def gap(curve: list[Point], point: Point) -> float:
    """Bytes of a point more than of a curve at its PSNR, in percent; beyond its ends the curve goes on straight."""
    return 100 * (point["bytes"] / (size_at(curve, "psnr", point["psnr"], beyond=True) or np.nan) - 1)


def study(
    results: Results, evaluated: EvaluatedScene, device: Device, knobs: Sequence[str], qualities: Sequence[float]
) -> None:
    """The table of a scene."""
    with evaluated as evaluator:
        table = results.table(
            evaluator.name, f"Run time against error, {evaluator.name}",
            "knob; value; time, in that of the default||.2f; bytes at equal PSNR|%|+.2f; an encode|s|.2f",
        )  # fmt: skip
        for preset in dict.fromkeys(KNOBS[name][0] for name in knobs):
            encode_once = partial(encoded, evaluator, device, preset)
            for _ in range(_WARM):
                encode_once(qualities[-1], {})
            curve = {q: encode_once(q, {}) for q in (*qualities, *AROUND)}
            turned = {
                (name, value): [encode_once(q, {KNOBS[name][1]: value}) for q in qualities]
                for name in knobs
                if KNOBS[name][0] == preset
                for value in KNOBS[name][2]
            }
            # Encodes go on getting faster for a long time: of those before and after the others the faster one counts.
            usual = [min(curve[q]["seconds"], encode_once(q, {})["seconds"]) for q in qualities]
            table.add(f"all of {preset}", "default", 1.0, 0.0, float(np.mean(usual)))
            for (name, value), points in turned.items():
                seconds = [point["seconds"] for point in points]
                times = [own / default for own, default in zip(seconds, usual, strict=True)]
                gaps = [gap(list(curve.values()), point) for point in points]
                table.add(name, _said(value), *map(float, map(np.mean, (times, gaps, seconds))))


def _said(value: Any) -> str:
    return (", ".join(map(str, value)) or "none") if isinstance(value, tuple) else f"{value:g}"


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--knobs", nargs="+", choices=KNOBS, default=list(KNOBS))
    parser.add_argument("--qualities", nargs="+", type=float, default=list(QUALITIES), metavar="Q")
    parser.add_argument("--few", type=int, default=1, metavar="N", help="take each N-th view only, for slow devices")
    parser.add_argument("--scale", type=float, default=1.0, metavar="X", help="of the pictures' width and height")
    args = parser.parse_args()
    device = Device(choose_device(args.device))
    results = Results(device.info, args.json)
    for folder in args.scenes:
        evaluated = EvaluatedScene(folder, device, few=args.few, scale=args.scale)
        study(results, evaluated, device, args.knobs, args.qualities)


if __name__ == "__main__":
    main()
