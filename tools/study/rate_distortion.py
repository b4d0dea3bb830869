"""Size against quality: encode at many qualities, decode, judge by all test views; then tables and plots.

    python -m tools.study.rate_distortion measure SCENE … --json OUT.json [--series NAME[:OPTION=VALUE,…] …] [options]
    python -m tools.study.rate_distortion report OUT.json … [--json FILE] [options]

A SCENE is a folder with point_cloud.ply, cameras.json and, if it has any, photographs in images. A series is a curve:
the name it gets and the options of EncodeOptions in which it differs from the defaults, those of a stage with its
name, as in exact:preset=best,prune.tolerance=0; photos=True stands for --photos with the folder images. ``measure``
writes its results after every encode and goes on where an existing file stops; with --seconds it begins no encode
after that many. Several files of ``measure`` become one curve: where a run was cut short, or another commit went on.
--series takes some of their series alone, in that order. ``report`` prints the tables of docs/benchmarks, and keeps
them with --json: the curves, the uncompressed scenes, and the seconds of each stage at quality 0.5. With --against it
prints instead how many bytes more or fewer each series takes at the PSNR that the series NAME has at quality Q, by
interpolation, and how long its encodes take.

What the joint re-fit brings, for one: ``--series paper:preset=paper "as they were:preset=paper,compact=False"
joint:preset=paper,compact=False,refit.steps=24,refit.drop=1e-9``, then ``report --against paper``.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import math
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.decoder import open_file
from potr_cl.errors import UsageError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.file import file_report
from tools.results import Cell, Column, Results, circumstances, write_json
from tools.study.evaluation import EvaluatedScene

#: Columns of the table of stages, and what an encode calls them.
_STAGES = {
    "views between": ("views between",),
    "prepare views": ("prepare views",),
    "prune": ("prune",),
    "compact or re-fit": ("compact", "refit"),
    "octree, quantise and code": ("octree", "entropy coding"),
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


def merged(paths: Sequence[Path], chosen: Sequence[str] = ()) -> dict[str, Any]:
    """What ``measure`` left in some files, as if one run had measured it; of equal points the later file's stays.

    Args:
        paths: files of ``measure``, one or more.
        chosen: take these series alone, in this order; empty: all of them. A scene may lack some of them.

    Returns:
        The same structure; "commit" names those of all points, each once, "machine", "date" and "command" those of the
        files that a point is taken of.

    Raises:
        UsageError: none of the files has a series of that name.
    """
    files = [json.loads(path.read_text()) for path in paths]
    scenes: dict[str, Any] = {}
    for number, file in enumerate(files):
        about = {"commit": file.get("commit", "unknown"), "file": number}
        for name, entry in file["scenes"].items():
            kept = scenes.setdefault(name, {**entry, "series": {}})["series"]
            for series, curve in entry["series"].items():
                points = {p["q"]: p for each in (kept.get(series), curve) if each for p in each["encodes"]}
                kept[series] = {**curve, "encodes": [{**about, **points[q]} for q in sorted(points)]}
    for entry in scenes.values():
        order = chosen or list(entry["series"])
        entry["series"] = {name: entry["series"][name] for name in order if name in entry["series"]}
    for name in chosen:
        if not any(name in entry["series"] for entry in scenes.values()):
            raise UsageError(f"{', '.join(map(str, paths))}: there is no series '{name}'")
    all_points = [p for entry in scenes.values() for curve in entry["series"].values() for p in curve["encodes"]]
    used = [files[number] for number in sorted({point.pop("file") for point in all_points})]
    said = {
        key: between.join(dict.fromkeys(file[key] for file in used if key in file))
        for key, between in (("machine", "; "), ("date", ", "))
    }
    commands = list(dict.fromkeys(command for file in used for command in file.get("command", [])))
    commit = "; ".join(dict.fromkeys(point["commit"] for point in all_points))
    return {**files[0], "scenes": scenes, **said, "command": commands, "commit": commit}


def size_at(points: Sequence[dict[str, Any]], key: str, value: float, beyond: bool = False) -> float | None:
    """Bytes at which a curve reaches ``value`` of ``key``, bytes as logarithms.

    Args:
        beyond: go on straight beyond the curve's ends; else there is nothing there.
    """
    ordered = sorted(points, key=lambda p: float(p[key]))
    values, sizes = np.array([p[key] for p in ordered]), np.log([p["bytes"] for p in ordered])
    if not (beyond or values[0] <= value <= values[-1]):
        return None
    if len(values) == 1:
        return float(np.exp(sizes[0]))
    at = min(max(int(np.searchsorted(values, value)), 1), len(values) - 1)
    slope = (sizes[at] - sizes[at - 1]) / (values[at] - values[at - 1])
    return float(np.exp(sizes[at] + slope * (value - values[at])))


def print_gaps(results: Results, scenes: dict[str, Any], against: str, q: float) -> None:
    """Bytes at equal PSNR, a row a series.

    Raises:
        UsageError: a scene has no encode of ``against`` at quality ``q``.
    """
    heads = (Column(f"{scene}: {what}", unit, form) for scene in scenes for what, unit, form in
             (("bytes", "%", "+.1f"), ("encode", "s", ".2f")))  # fmt: skip
    table = results.table("gaps", f"Against {against} at quality {q:g}, at equal PSNR", "series", *heads)
    for series in next(iter(scenes.values()))["series"]:
        cells: list[Cell] = []
        for name, entry in scenes.items():
            points = entry["series"][series]["encodes"]
            reference = entry["series"].get(against, {"encodes": []})["encodes"]
            at = next((point for point in reference if point["q"] == q), None)
            if at is None:
                raise UsageError(f"{name} has no encode of '{against}' at quality {q:g}")
            size = size_at(points, "psnr", at["psnr"])
            cells.append(100 * size / at["bytes"] - 100 if size else "beyond its ends")
            cells.append(statistics.median(sum(point["seconds"].values()) for point in points))
        table.add(series, *cells)


def keep_tables(measured: dict[str, Any], path: Path | None) -> None:
    """The tables of docs/benchmarks: a curve for each scene, "uncompressed", and "stages"."""
    results = Results(None, path, measured)
    scenes: dict[str, Any] = measured["scenes"]
    for name, entry in scenes.items():
        table = results.table(
            name,
            f"Size and quality of {name} by preset and quality, all test views",
            "preset; q; splats||,; size|MB|.3f; times smaller||.1f; bytes a splat||.2f; "
            "PSNR against uncompressed|dB|.2f; SSIM against uncompressed||.4f; "
            "PSNR against photographs|dB|.2f; SSIM against photographs||.4f; lost|dB|.2f",
        )  # fmt: skip
        for series, curve in entry["series"].items():
            for p in curve["encodes"]:
                size = (p["bytes"] / 1e6, entry["source_bytes"] / p["bytes"], p["bytes"] / p["splats"])
                truth = (p.get("truth_psnr"), p.get("truth_ssim"), p.get("psnr_loss"))
                table.add(series, p["q"], p["splats"], *size, p["psnr"], p["ssim"], *truth)
    table = results.table(
        "uncompressed",
        "The uncompressed scenes against their photographs, all test views",
        "scene; splats||,; PLY bytes||,; test views; PSNR against photographs|dB|.2f; SSIM against photographs||.4f",
    )
    for name, entry in scenes.items():
        plain = entry["uncompressed"]
        counts = (entry["source_splats"], entry["source_bytes"], entry["test_views"])
        table.add(name, *counts, plain.get("truth_psnr"), plain.get("truth_ssim"))
    table = results.table(
        "stages",
        "Whole encodes at quality 0.5, stage by stage, in a process that has encoded before",
        "scene; preset; splats kept||,; bytes||,; times smaller than the PLY||.1f; "
        "PSNR against the uncompressed renders|dB|.2f; lost on the photographs|dB|.2f",
        *(Column(stage, "s", ".2f") for stage in _STAGES),
        "in all|s|.2f",
    )  # fmt: skip
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
    measured = merged(args.results, args.series)
    if args.against is not None:
        print_gaps(Results(None, args.json, measured), measured["scenes"], args.against, args.at)
    else:
        keep_tables(measured, args.json)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    measure, report = commands.add_parser("measure"), commands.add_parser("report")
    measure.set_defaults(run=_measure)
    measure.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    measure.add_argument("--json", type=Path, required=True)
    measure.add_argument("--device", help="as for potr-cl")
    measure.add_argument("--qualities", nargs="+", type=float, default=QUALITIES, metavar="Q")
    measure.add_argument("--seconds", type=float, default=math.inf, metavar="S")
    measure.add_argument("--series", nargs="+", default=["default"], metavar="NAME[:OPTION=VALUE,…]")
    report.set_defaults(run=_report)
    report.add_argument("results", type=Path, nargs="+", help="the JSON that measure wrote")
    report.add_argument("--json", type=Path, metavar="FILE", help="keep the tables for docs/benchmarks")
    report.add_argument("--series", nargs="+", default=[], metavar="NAME", help="these alone, in this order")
    report.add_argument("--against", metavar="NAME")
    report.add_argument("--at", type=float, default=0.5, metavar="Q")
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
