"""Size against quality: encode at many qualities, decode, judge by all test views; then tables and plots.

    python -m tools.study.rate_distortion measure SCENE … --json OUT.json [--series NAME[:OPTION=VALUE,…] …] [options]
    python -m tools.study.rate_distortion report OUT.json … [--json FILE] [options]

A SCENE is a folder with point_cloud.ply, cameras.json and, if it has any, photographs in images. A series is a curve:
the name it gets and the options of EncodeOptions in which it differs from the defaults, those of a stage with its name,
as in exact:preset=best,prune.tolerance=0; photos=True stands for --photos with the folder images. ``measure`` writes
its results after every encode and goes on where an existing file stops; with --seconds it begins no encode after that
many. Several files of ``measure`` become one curve (tools.study.curves); --series takes some of their series alone,
in that order. ``report`` prints the tables of docs/benchmarks, and keeps them with --json: the curves, the uncompressed
scenes, and the seconds of each stage at quality 0.5. With --against it prints instead how many bytes more or fewer each
series takes at the PSNR that the series NAME has at quality Q, by interpolation, and how long its encodes take.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.decoder import open_file
from potr_cl.errors import UsageError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.file import file_report
from tools.results import Column, Results, circumstances, write_json
from tools.study.curves import merged
from tools.study.evaluation import EvaluatedScene
from tools.workloads import study_parser

#: Columns of the table of stages, and what an encode calls them.
_STAGES = {
    "views between": ("views between",),
    "prepare views": ("prepare views",),
    "prune": ("prune",),
    "compact or re-fit": ("compact", "refit"),
    "octree, quantise and code": ("octree", "quantise and code"),
}
QUALITIES = tuple(round(0.1 * step, 1) for step in range(1, 11))


# ------------------------------------------------------------------------------------------- measurement


def parse_series(text: str) -> tuple[str, dict[str, Any]]:
    """``NAME:OPTION=VALUE,…`` to the name and the options; those of a stage are STAGE.OPTION, STAGE alone is a switch.

    Raises:
        UsageError: there is no such option.
    """
    name, _, rest = text.partition(":")
    options: dict[str, Any] = {}
    known = {"photos"} | {field.name for field in dataclasses.fields(EncodeOptions)} - {"q", "stages"}
    for stage in EncodeOptions().stages:
        known |= {stage.name, *(f"{stage.name}.{field.name}" for field in dataclasses.fields(stage))}
    for part in filter(None, rest.split(",")):
        key, _, value = part.partition("=")
        if key not in known:
            raise UsageError(f"--series {text}: '{key}' is no option, expected one of {', '.join(sorted(known))}")
        try:
            options[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            options[key] = value
    return name, options


def encode_options(changes: dict[str, Any], images: Path | None = None) -> EncodeOptions:
    """The options of a series, quality included.

    Args:
        changes: to the defaults; "photos" is whether ``images``, the scene's photographs, are fitted to.
    """
    nested: dict[str, Any] = {}
    changes = dict(changes)
    if changes.pop("photos", False):
        changes["refit.ground_truth"] = images
    for key, value in changes.items():
        stage, _, option = key.partition(".")
        if option:
            nested.setdefault(stage, {})[option] = value
        else:
            nested[stage] = value
    return EncodeOptions.for_preset(**nested)


def measure_encode(evaluator: EvaluatedScene, options: EncodeOptions, device: Device) -> dict[str, Any]:
    """One encode with everything that it costs and keeps."""
    encoded = encode(evaluator.source, evaluator.cameras, options, device=device)
    file = open_file(b"".join(encoded.pieces))
    report = file_report(file)
    return {
        "q": options.q,
        "bytes": encoded.nbytes,
        "splats": len(encoded.order),
        "sections": {name: section["bytes"] for name, section in report["sections"].items()},
        "seconds": encoded.seconds,
        **evaluator(file.scene()),
    }


def _measure(args: argparse.Namespace) -> None:
    series = dict(parse_series(text) for text in args.series)
    began, device = time.perf_counter(), Device(args.device)
    results: dict[str, Any] = {"scenes": {}}
    if args.json.exists():
        results = json.loads(args.json.read_text())
    results |= {**circumstances(device.info), "device": device.info.name}
    for folder in args.scenes:
        with EvaluatedScene(folder, device) as evaluator:
            entry = results["scenes"].setdefault(evaluator.name, {**evaluator.facts(), "series": {}})
            for name, options in series.items():
                curve = entry["series"].setdefault(name, {"options": options, "encodes": []})
                done = {point["q"] for point in curve["encodes"]}
                for q in args.qualities:
                    if q in done or time.perf_counter() - began > args.seconds:
                        continue
                    point = measure_encode(evaluator, encode_options({**options, "q": q}, folder / "images"), device)
                    curve["encodes"].append({**point, "commit": results["commit"]})
                    curve["encodes"].sort(key=lambda p: p["q"])
                    write_json(args.json, results)
                    print(
                        f"{evaluator.name} {name} q {q:g}: {point['bytes']} bytes, {point['psnr']:.2f} dB", flush=True
                    )


# ------------------------------------------------------------------------------------------------ report


def size_at(points: list[dict[str, Any]], key: str, value: float) -> float | None:
    """Bytes at which a curve reaches ``value`` of ``key``; None beyond its ends."""
    ordered = sorted(points, key=lambda p: float(p[key]))
    values = [p[key] for p in ordered]
    if not values[0] <= value <= values[-1]:
        return None
    return float(np.exp(np.interp(value, values, np.log([p["bytes"] for p in ordered]))))


def print_gaps(scenes: dict[str, Any], against: str, q: float) -> None:
    """Bytes at equal PSNR, a row a series."""
    print(
        "| | "
        + " | ".join(f"{name}: bytes | encode" for name in scenes)
        + " |\n"
        + "|---" * (2 * len(scenes) + 1)
        + "|"
    )
    for series in next(iter(scenes.values()))["series"]:
        cells = []
        for entry in scenes.values():
            points = entry["series"][series]["encodes"]
            reference = entry["series"][against]["encodes"]
            (at,) = (point["psnr"] for point in reference if point["q"] == q)
            size, usual = size_at(points, "psnr", at), size_at(reference, "psnr", at)
            gap = f"{100 * size / usual - 100:+.1f} %" if size and usual else "beyond its ends"
            seconds = statistics.median(sum(point["seconds"].values()) for point in points)
            cells.append(f"{gap} | {seconds:.2f} s")
        print(f"| {series} | " + " | ".join(cells) + " |")


def keep_tables(measured: dict[str, Any], path: Path | None) -> None:
    """The tables of docs/benchmarks: a curve for each scene, "uncompressed", and "stages"."""
    results = Results(None, path, measured)
    scenes: dict[str, Any] = measured["scenes"]
    for name, entry in scenes.items():
        table = results.table(
            name,
            f"Size and quality of {name} by preset and quality, all test views",
            Column("preset", default="{preset}"),
            Column("q", default="{quality:g}"),
            Column("splats", format=","),
            Column("size", "MB", ".3f"),
            Column("times smaller", format=".1f"),
            Column("bytes a splat", format=".2f"),
            Column("PSNR against uncompressed", "dB", ".2f"),
            Column("SSIM against uncompressed", format=".4f"),
            Column("PSNR against photographs", "dB", ".2f"),
            Column("SSIM against photographs", format=".4f"),
            Column("lost", "dB", ".2f"),
        )
        for series, curve in entry["series"].items():
            for p in curve["encodes"]:
                size = (p["bytes"] / 1e6, entry["source_bytes"] / p["bytes"], p["bytes"] / p["splats"])
                truth = (p.get("truth_psnr"), p.get("truth_ssim"), p.get("psnr_loss"))
                table.add(series, p["q"], p["splats"], *size, p["psnr"], p["ssim"], *truth)
    table = results.table(
        "uncompressed",
        "The uncompressed scenes against their photographs, all test views",
        Column("scene"),
        Column("splats", format=","),
        Column("PLY bytes", format=","),
        Column("test views"),
        Column("PSNR against photographs", "dB", ".2f"),
        Column("SSIM against photographs", format=".4f"),
    )
    for name, entry in scenes.items():
        plain = entry["uncompressed"]
        counts = (entry["source_splats"], entry["source_bytes"], entry["test_views"])
        table.add(name, *counts, plain.get("truth_psnr"), plain.get("truth_ssim"))
    table = results.table(
        "stages",
        "Whole encodes at quality 0.5, stage by stage, in a process that has encoded before",
        Column("scene"),
        Column("preset", default="{preset}"),
        Column("splats kept", format=","),
        Column("bytes", format=","),
        Column("times smaller than the PLY", format=".1f"),
        Column("PSNR against the uncompressed renders", "dB", ".2f"),
        Column("lost on the photographs", "dB", ".2f"),
        *(Column(stage, "s", ".2f") for stage in _STAGES),
        Column("in all", "s", ".2f"),
    )
    for name, entry in scenes.items():
        for series, curve in entry["series"].items():
            for p in curve["encodes"]:
                if p["q"] == 0.5:
                    smaller = entry["source_bytes"] / p["bytes"]
                    seconds = [sum(p["seconds"].get(part, 0.0) for part in parts) for parts in _STAGES.values()]
                    table.add(
                        name, series, p["splats"], p["bytes"], smaller, p["psnr"], p.get("psnr_loss"), *seconds,
                        sum(p["seconds"].values()),
                    )  # fmt: skip


def _report(args: argparse.Namespace) -> None:
    results = merged([args.results, *args.more], args.series)
    if args.against is not None:
        for name, entry in results["scenes"].items():
            measured = {point["q"] for point in entry["series"].get(args.against, {"encodes": []})["encodes"]}
            if args.at not in measured:
                raise UsageError(f"{args.results}: {name} has no encode of '{args.against}' at quality {args.at:g}")
        print_gaps(results["scenes"], args.against, args.at)
        return
    keep_tables(results, args.json)


def main() -> None:
    parser, measure, report = study_parser(__doc__, _measure, _report)
    measure.add_argument("--qualities", nargs="+", type=float, default=QUALITIES, metavar="Q")
    measure.add_argument("--seconds", type=float, default=math.inf, metavar="S")
    measure.add_argument("--series", nargs="+", default=["default"], metavar="NAME[:OPTION=VALUE,…]")
    report.add_argument("more", nargs="*", type=Path, metavar="OUT.json", help="further files of measure")
    report.add_argument("--series", nargs="+", default=[], metavar="NAME", help="these alone, in this order")
    report.add_argument("--json", type=Path, metavar="FILE", help="keep tables for docs/benchmarks")
    report.add_argument("--against", metavar="NAME")
    report.add_argument("--at", type=float, default=0.5, metavar="Q")
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
