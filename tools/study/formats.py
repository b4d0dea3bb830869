"""Other formats: how small and good our encodes to them are, and what other programs make of the same scenes.

    python -m tools.study.formats SCENE … [--q Q …] [--formats NAME …] [--transform COMMAND] [--curves CURVES.json …]
        [--series best] [--json FILE]

Each scene is encoded straight to each format, and all of it converted, judged by all test views through our own readers
and, where they are there, through splat-transform (npm's @playcanvas/splat-transform) and gaussforge (PyPI's). With
--others splat-transform writes the scene, too. Then: how much smaller an encode of the same PSNR, and of the same loss
on photographs, is than others' files; and the same for .potr files, by interpolation along the curves of
tools.study.rate_distortion. Files of others are those that were just written and those of the table "sizes" of
docs/benchmarks/results/other_formats.json, whose authors' programs have written them.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from potr_cl.errors import UsageError
from potr_cl.formats import load_scene, save_scene
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.outputs.registry import output_of_suffix
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.results import ROOT, Cell, Column, Results
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import merged, size_at
from tools.workloads import log, scene_parser

#: Suffixes, with a version behind a colon.
FORMATS = (".spz:2", ".spz:4", ".sog", ".compressed.ply")
READERS = ("splat-transform", "gaussforge")
KNOWN = ROOT / "docs" / "benchmarks" / "results" / "other_formats.json"
Entry = dict[str, Any]


def study(results: Results, folder: Path, device: Device, args: argparse.Namespace) -> None:
    """The tables of a scene."""
    with EvaluatedScene(folder, device) as evaluator, tempfile.TemporaryDirectory() as scratch:
        name = evaluator.name
        readers = (Column(f"PSNR by {reader}", "dB", ".2f") for reader in READERS)
        table = results.table(
            f"outputs_{name}", f"Other formats: {name}, all test views",
            "writer; format; q||g; splats||,; size|MB|.2f; PSNR|dB|.2f; lost|dB|.2f", *readers, "time|s|.1f",
        )  # fmt: skip
        files = []
        for writer, form, q in _plan(args):
            path, began = Path(scratch, f"file{form.partition(':')[0]}"), time.perf_counter()
            splats = _write(writer, form, q, path, evaluator, folder, device, args)
            seconds, size = time.perf_counter() - began, path.stat().st_size
            file: Entry = {"writer": writer, "format": form, "bytes": size, **evaluator(load_scene(path))}
            by_others = _other_readers(args.transform, path, Path(scratch, "read.ply"), evaluator)
            figures = (file["psnr"], file.get("psnr_loss"), *(by_others.get(reader) for reader in READERS))
            table.add(writer, form, q, splats, size / 1e6, *figures, seconds)
            files.append(file)
    theirs, encodes = others(name, files), [file for file in files if file["writer"] == "encode"]
    for form in dict.fromkeys(file["format"] for file in encodes):
        same = [file for file in theirs if file["format"] == form.partition(":")[0]]
        against(results, f"{form}_{name}", form, [file for file in encodes if file["format"] == form], same)
    if args.curves:
        curves = merged(args.curves, [args.series])["scenes"].get(name, {"series": {}})["series"]
        if not curves.get(args.series, {"encodes": []})["encodes"]:
            raise UsageError(f"there is no curve '{args.series}' of {name}")
        against(results, name, args.series, curves[args.series]["encodes"], theirs)


def _write(
    writer: str, form: str, q: float, path: Path, evaluator: EvaluatedScene, folder: Path, device: Device,
    args: argparse.Namespace,
) -> int:  # fmt: skip
    """Have a file written; its splats."""
    if writer == "encode":
        suffix, _, version = form.partition(":")
        output = output_of_suffix(suffix, version=int(version) if version else None)
        options = EncodeOptions(q=q, output=output).changed(fit={"steps": args.fit})
        encoded = encode(evaluator.source, train_views(evaluator.cameras), options, device=device)
        encoded.save(path)
        return len(encoded.order)
    if writer == "convert":
        save_scene(path, evaluator.source)
    else:
        _transform(args.transform, folder / "point_cloud.ply", path)
    return len(evaluator.source)


def _plan(args: argparse.Namespace) -> list[tuple[str, str, float]]:
    """Who writes what at which quality."""
    whole = list(dict.fromkeys(name.partition(":")[0] for name in args.formats))
    plan = [("encode", name, q) for q in args.q for name in args.formats]
    return plan + [(who, name, 1.0) for who in ("convert", *(("other",) if args.others else ())) for name in whole]


def _transform(command: str, source: Path, target: Path) -> None:
    done = subprocess.run([*shlex.split(command), "-w", str(source), str(target)], capture_output=True, text=True)
    if done.returncode:
        raise UsageError(f"'{command}' failed: {done.stderr.strip()[-300:]}")


def _other_readers(command: str, path: Path, ply: Path, evaluator: EvaluatedScene) -> dict[str, Any]:
    """PSNR of a file as others decode it; those that are not here, or refuse it, are left out."""
    found = {}
    try:
        _transform(command, path, ply)
        found["splat-transform"] = evaluator(load_scene(ply))["psnr"]
    except (OSError, UsageError) as error:
        log(f"splat-transform: {error}")
    try:
        import gaussforge

        kind = "compressed.ply" if path.name.endswith(".compressed.ply") else path.suffix[1:]
        made = gaussforge.GaussForge().convert(path.read_bytes(), kind, "ply")
        if made.get("error"):
            raise UsageError(made["error"])
        ply.write_bytes(bytes(made["data"]))
        found["gaussforge"] = evaluator(load_scene(ply))["psnr"]
    except (ImportError, UsageError) as error:
        log(f"gaussforge: {error}")
    return found


def others(scene: str, files: list[Entry]) -> list[Entry]:
    """Files of other writers: measured ones, and those that docs/benchmarks knows of."""
    found = [file for file in files if file["writer"] == "other"]
    sizes = json.loads(KNOWN.read_text())["sizes"]
    heads = [column["name"] for column in sizes["columns"]]
    for row in (dict(zip(heads, cells, strict=True)) for cells in sizes["rows"]):
        name = row["format"].strip("`").partition("`")[0]
        if row.get(f"{scene}: PSNR") is not None and name not in {file["format"] for file in found}:
            size, psnr, lost = (row[f"{scene}: {what}"] for what in ("size", "PSNR", "lost"))
            found.append({"format": name, "bytes": size * 1e6, "psnr": psnr, "psnr_loss": lost})
    return found


def against(results: Results, name: str, called: str, curve: list[Entry], files: list[Entry]) -> None:
    """A table of a curve against files, if there are any, by interpolation along it."""
    if not files:
        return
    table = results.table(
        name, f"{called} against other formats, by interpolation along its curve",
        "format; size|MB|.2f; PSNR|dB|.2f", Column(f"{called} at that PSNR", "MB", ".2f"),
        "times smaller||.1f; lost|dB|.2f", Column(f"{called} at that loss", "MB", ".2f"),
        "times smaller at that loss||.1f",
    )  # fmt: skip
    for file in files:
        cells: list[Cell] = []
        for key in ("psnr", "psnr_loss"):
            points = [point for point in curve if point.get(key) is not None]
            cells += [file.get(key), *_how_small(points, key, file)]
        table.add(file["format"], file["bytes"] / 1e6, *cells)


def _how_small(points: list[Entry], key: str, file: Entry) -> tuple[Cell, Cell]:
    """MB at which a curve is as good as a file, and how many times smaller that is; in words beyond its end."""
    if file.get(key) is None or not points:
        return None, None
    size, least = size_at(points, key, file[key]), min(points, key=lambda p: int(p["bytes"]))
    if size is not None:
        return size / 1e6, file["bytes"] / size
    if (file[key] > least[key]) != (key == "psnr_loss"):  # better than all of the curve
        return None, None
    return f"below {least['bytes'] / 1e6:.2f}", f"more than {file['bytes'] / least['bytes']:.1f}"


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--q", type=float, nargs="*", default=(0.1, 0.3, 0.5, 0.8), help="qualities of encodes")
    parser.add_argument("--formats", nargs="*", default=FORMATS, metavar="NAME", help="a suffix, or .spz:VERSION")
    parser.add_argument("--fit", type=int, default=0, metavar="STEPS", help="fit all parameters too")
    parser.add_argument("--transform", default="splat-transform", metavar="COMMAND")
    parser.add_argument("--others", action="store_true", help="have splat-transform write the scene, too")
    parser.add_argument("--curves", type=Path, nargs="*", default=[], help="of tools.study.rate_distortion")
    parser.add_argument("--series", default="best", metavar="NAME", help="of the curves")
    args = parser.parse_args()
    if args.curves:
        merged(args.curves, [args.series])  # refuses a series that is not there before anything is measured
    device = Device(args.device)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        study(results, folder, device, args)


if __name__ == "__main__":
    main()
