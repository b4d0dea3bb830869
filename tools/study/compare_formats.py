"""What people would use instead: other formats and codecs on the same scenes, against our rate-distortion curve.

    python -m tools.study.compare_formats measure SCENE … --json OUT.json [--transform COMMAND] [options]
    python -m tools.study.compare_formats report OUT.json RATE_DISTORTION.json … [--json RESULTS.json]

``measure`` writes each scene in each format with splat-transform (npm's @playcanvas/splat-transform), lets the same
tool decode it to a PLY, and judges that by all test views. A format that does not finish in time is left out.
The rows of :data:`EARLIER` are added. ``report`` prints the tables of docs/benchmarks and keeps them with --json: our
size at their PSNR and at their loss, interpolated along the curve that tools.study.rate_distortion measured, linearly
in the logarithm of the size, and that --series names, by default best. OUT.json may be
the page's own results, docs/benchmarks/results/other_formats.json: other formats do not change as ours does.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from potr_cl.errors import UsageError
from potr_cl.formats import load_scene
from potr_cl.opencl.device import Device
from tools.results import Cell, Column, Results, circumstances, write_json
from tools.study.curves import merged
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import size_at
from tools.workloads import study_parser

FORMATS = ("compressed.ply", "spz", "sog")

#: Measured earlier on the same scenes and test views, each with its authors' code on an NVIDIA GPU: size in MB, dB lost
#: against the photographs, PSNR against the uncompressed renders. No fine-tuning unless said.
EARLIER: dict[str, dict[str, tuple[float, float, float]]] = {
    "lego": {
        "SOG": (6.00, 0.46, 45.0),
        "MesonGS": (3.30, 1.28, 40.4),
        "C3DGS": (3.98, 1.16, 41.8),
        "C3DGS, fine-tuned": (4.06, 0.28, 43.2),
        "FlexGaussian": (6.24, 1.95, 38.8),
        "LightGaussian": (9.03, 2.53, 36.9),
    },
    "plush": {
        "SOG": (6.87, 0.15, 40.9),
        "MesonGS": (5.17, 0.47, 36.2),
        "C3DGS": (6.15, 0.06, 40.9),
        "C3DGS, fine-tuned": (6.22, 0.06, 40.0),
        "FlexGaussian": (6.74, 0.48, 36.5),
        "LightGaussian": (12.4, 0.25, 38.4),
    },
}


# ------------------------------------------------------------------------------------------- measurement


def _run(command: list[str], timeout: float) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=timeout)
    except FileNotFoundError as error:
        raise UsageError(f"there is no command '{command[0]}': npm install @playcanvas/splat-transform") from error
    except subprocess.CalledProcessError as error:
        raise UsageError(f"'{shlex.join(command)}' failed: {error.stderr.strip()[-300:]}") from error


def _through(
    evaluator: EvaluatedScene, source: Path, suffix: str, transform: list[str], timeout: float
) -> dict[str, Any] | None:
    """Write a scene in one format, decode it, judge it; None if that did not finish."""
    with tempfile.TemporaryDirectory() as folder:
        coded, decoded = Path(folder) / f"scene.{suffix}", Path(folder) / "decoded.ply"
        began = time.perf_counter()
        try:
            _run([*transform, str(source), str(coded)], timeout)
        except subprocess.TimeoutExpired:
            print(f"{evaluator.name} {suffix}: did not finish in {timeout:g} s", file=sys.stderr)
            return None
        seconds = time.perf_counter() - began
        _run([*transform, str(coded), str(decoded)], timeout)
        row = {"format": f".{suffix}", "bytes": coded.stat().st_size, "seconds": seconds, "measured": True}
        return row | evaluator(load_scene(decoded))


def _measure(args: argparse.Namespace) -> None:
    transform = shlex.split(args.transform)
    version = subprocess.run([*transform, "--version"], capture_output=True, text=True, check=True)
    device = Device(args.device)
    tool = (version.stdout + version.stderr).strip()
    results: dict[str, Any] = {**circumstances(device.info), "tool": tool, "scenes": {}}
    for folder in args.scenes:
        with EvaluatedScene(folder, device) as evaluator:
            rows = [_through(evaluator, folder / "point_cloud.ply", f, transform, args.timeout) for f in args.formats]
            measured = [row for row in rows if row is not None]
            for name, (size, lost, psnr) in EARLIER.get(evaluator.name, {}).items():
                if f".{name.lower()}" not in {row["format"] for row in measured}:
                    row = {"format": name, "bytes": round(size * 1e6), "psnr": psnr, "psnr_loss": lost}
                    measured.append({**row, "measured": False})
            results["scenes"][evaluator.name] = {**evaluator.facts(), "formats": measured}
            write_json(args.json, results)


# ------------------------------------------------------------------------------------------------ report


def measured_formats(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The formats of each scene: what ``measure`` has left, or the table "sizes" of docs/benchmarks."""
    content = json.loads(path.read_text())
    if "scenes" in content:
        return {name: entry["formats"] for name, entry in content["scenes"].items()}
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in EARLIER}
    heads = [column["name"] for column in content["sizes"]["columns"]]
    for cells in content["sizes"]["rows"]:
        row = dict(zip(heads, cells, strict=True))
        suffix = re.match(r"`(\.[a-z.]+)`", row["format"])
        if suffix is None or suffix[1] == ".sog":  # was measured earlier
            continue
        for scene, rows in found.items():
            size, psnr, lost = (row[f"{scene}: {what}"] for what in ("size", "PSNR", "lost"))
            rows.append({"format": suffix[1], "bytes": size * 1e6, "psnr": psnr, "psnr_loss": lost, "measured": True})
    for scene, rows in found.items():
        for name, (size, lost, psnr) in EARLIER[scene].items():
            rows.append({"format": name, "bytes": size * 1e6, "psnr": psnr, "psnr_loss": lost, "measured": False})
    return found


def keep_tables(
    formats: dict[str, list[dict[str, Any]]], curves: dict[str, Any], series: str, path: Path | None
) -> None:
    """The tables of docs/benchmarks: a series against each format, by interpolation along its curve.

    Raises:
        UsageError: a scene has no curve of that name.
    """
    results = Results(None, path, curves)
    for scene, rows in formats.items():
        points = curves["scenes"].get(scene, {"series": {}})["series"].get(series, {"encodes": []})["encodes"]
        if not points:
            raise UsageError(f"there is no curve '{series}' of {scene}")
        table = results.table(
            scene,
            f"Preset {series} against other formats, by interpolation along its curve: {scene}",
            Column("format"),
            Column("size", "MB", ".2f"),
            Column("PSNR", "dB", ".2f"),
            Column(f"{series} at that PSNR", "MB", ".2f"),
            Column("times smaller", format=".1f"),
            Column("lost", "dB", ".2f"),
            Column(f"{series} at that loss", "MB", ".2f"),
            Column("times smaller at that loss", format=".1f"),
        )
        for row in rows:
            cells: list[Cell] = []
            for key in ("psnr", "psnr_loss"):
                size = size_at(points, key, row[key])
                least = min(int(p["bytes"]) for p in points)
                cells += [row[key], *_how_small(row, size, least)]
            table.add(row["format"] + ("" if row["measured"] else " *"), row["bytes"] / 1e6, *cells)


def _how_small(row: dict[str, Any], size: float | None, least: int) -> tuple[Cell, Cell]:
    """MB at which the curve is as good as a format, and how many times smaller that is; in words beyond its end."""
    if size is not None:
        return size / 1e6, row["bytes"] / size
    return f"below {least / 1e6:.2f}", f"more than {row['bytes'] / least:.1f}"


def _report(args: argparse.Namespace) -> None:
    measured = merged([args.curves, *args.more], [args.series])
    keep_tables(measured_formats(args.results), measured, args.series, args.json)


def main() -> None:
    parser, measure, report = study_parser(__doc__, _measure, _report)
    measure.add_argument("--transform", default="npx splat-transform", metavar="COMMAND")
    measure.add_argument("--formats", nargs="+", choices=FORMATS, default=FORMATS)
    measure.add_argument("--timeout", type=float, default=3600, metavar="S", help="a format; default an hour")
    report.add_argument("curves", type=Path, help="what tools.study.rate_distortion measured")
    report.add_argument("more", nargs="*", type=Path, metavar="RATE_DISTORTION.json", help="further ones")
    report.add_argument("--series", default="best", metavar="NAME", help="of the tables that --json keeps")
    report.add_argument("--json", type=Path, metavar="FILE", help="keep tables for docs/benchmarks")
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
