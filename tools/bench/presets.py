"""What each preset takes and gives at quality 0.5: seconds of every stage and of the whole command, bytes, and loss.

    python -m tools.bench.presets SCENE … [--presets best fast …] [--runs 2] [--seconds S] [--device NAME] [--json FILE]

A SCENE is a folder with point_cloud.ply, cameras.json and, if it has any, photographs in images. Stages are those of
the fastest of some encodes in a process that has encoded with the preset before; the whole command is a fresh process,
the fastest too after one that is not counted, with reading, decoding and judging by all test views; a second table has
what it tells of itself. No preset is begun after S seconds, so the most interesting ones come first.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

from potr_cl.codec.decoder import open_file
from potr_cl.codec.quantize import PRESETS
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from tools.bench.whole_command import clocked, fresh_python
from tools.results import Column, Results
from tools.study.evaluation import EvaluatedScene

#: Columns of the table, and what an encode calls the stages in them.
STAGES = {
    "views between": ("views between",),
    "prepare views": ("prepare views",),
    "prune": ("prune",),
    "fit": ("fit",),
    "compact or re-fit": ("compact", "refit"),
    "octree, quantise and code": ("octree", "quantise and code"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=["best", "fast", "paper", "smallest"])
    parser.add_argument("--runs", type=int, default=2, metavar="R")
    parser.add_argument("--seconds", type=float, default=math.inf, metavar="S")
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the table for docs/benchmarks")
    args = parser.parse_args()
    began, device = time.perf_counter(), Device(args.device)
    results = Results(device.info, args.json)
    quality = (Column("bytes", format=","), Column("PSNR against the uncompressed renders", "dB", ".2f"))
    stages = results.table(
        "stages",
        "Whole encodes at quality 0.5, stage by stage",
        Column("scene"),
        Column("preset", default="{preset}"),
        Column("PLY bytes", format=","),
        Column("splats kept", format=","),
        *quality,
        Column("lost on the photographs", "dB", ".2f"),
        *(Column(stage, "s", ".2f") for stage in STAGES),
        Column("in all", "s", ".2f"),
        Column("the whole command", "s", ".1f"),
    )
    commands = results.table(
        "commands",
        "Whole commands at quality 0.5",
        Column("scene"),
        Column("preset", default="{preset}"),
        *quality,
        *(Column(part, "s", ".1f") for part in ("encode", "with reading and judging", "whole command")),
    )
    with tempfile.TemporaryDirectory() as folder:
        for preset in args.presets:
            for number, scene in enumerate(args.scenes):
                if time.perf_counter() - began > args.seconds:
                    continue
                # Once a preset, for both its kernels and the command's.
                rehearsals = int(number == 0)
                with EvaluatedScene(scene, device) as evaluator:
                    encoded, seconds = _fastest(evaluator, preset, device, args.runs, rehearsals)
                    judged = evaluator(open_file(b"".join(encoded.pieces)).scene())
                    facts = (evaluator.name, preset, evaluator.source_bytes, len(encoded.order), encoded.nbytes)
                whole, told = _whole_command(scene, preset, args.device, Path(folder), args.runs, rehearsals)
                by_stage = [sum(seconds.get(part, 0.0) for part in parts) for parts in STAGES.values()]
                stages.add(
                    *facts, judged["psnr"], judged.get("psnr_loss"), *by_stage, sum(seconds.values()), whole
                )  # fmt: skip
                spent = told["seconds"]
                alone = sum(value for part, value in spent.items() if part not in ("evaluate", "total"))
                figures = (told["bytes"], told["quality"]["psnr"])
                commands.add(scene.resolve().name, preset, *figures, alone, spent["total"], whole)


def _fastest(
    evaluator: EvaluatedScene, preset: str, device: Device, runs: int, rehearsals: int
) -> tuple[Encoded, dict[str, float]]:
    """An encode, and the seconds of the stages of the fastest one."""
    options = EncodeOptions.for_preset(preset)  # type: ignore[arg-type]
    encodes = [encode(evaluator.source, evaluator.cameras, options, device=device) for _ in range(runs + rehearsals)][
        rehearsals:
    ]
    return encodes[0], min((each.seconds for each in encodes), key=lambda seconds: sum(seconds.values()))


def _whole_command(
    scene: Path, preset: str, device: str | None, folder: Path, runs: int, rehearsals: int
) -> tuple[float, dict[str, Any]]:
    """Seconds of the fastest of some fresh commands, and what it tells with --json."""
    arguments = [
        "-m", "potr_cl", "encode", str((scene / "point_cloud.ply").resolve()), "-o", str(folder / "scene.potr"),
        "--cameras", str((scene / "cameras.json").resolve()), "--json", "--preset", preset,
        *(["--device", device] if device else []),
    ]  # fmt: skip
    runs_of_it = [clocked(lambda: fresh_python(arguments, folder)) for _ in range(runs + rehearsals)]
    seconds, said = min(runs_of_it[rehearsals:])
    return seconds, json.loads(said)


if __name__ == "__main__":
    main()
