"""Run time against error of all stages and whole encodes, on every OpenCL device.

    python -m tools.bench.encode                           every device, the scenes lego and plush
    python -m tools.bench.encode --quick                   the best device, the bundled excerpt; under two minutes
    python -m tools.bench.encode --scenes FOLDER …         folders with point_cloud.ply and cameras.json
    python -m tools.bench.encode --stages sort ridge       some stages only
    python -m tools.bench.encode --from benchmark.json     tables again

For each stage the variants that exist: kernel family, compiler flags, sort, skips, iterations,
steps, entropy coder, preset; each with its time and its error against float64 or against the full computation. A
variant is on the Pareto front if no other of its stage is at least as good in time, error and bytes and better in one
by more than the noise of 5 %.

Every device runs in a process of its own. Times of the rasterizer's kernels and of the ridge are the device's own, the
others the clock's. Each is the best of some. Prints Markdown; --json keeps the figures.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from potr_cl.opencl.discovery import DeviceInfo, choose_device, list_devices
from tools.bench.stage_variants import Workload, measure
from tools.bench.tradeoffs import STAGES, print_report
from tools.results import circumstances, processor
from tools.workloads import SCENES, excerpt


def header(info: DeviceInfo) -> dict[str, str]:
    """The machine and the versions."""
    packages = ("potr-cl", "pyopencl", "numpy", "zstandard")
    versions = []
    for package in packages:
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{package} not installed")
    return {
        "device": f"{info.name}, {info.platform}, {info.version}, driver {info.handle.driver_version}",
        "machine": f"{processor()}, {os.cpu_count()} processors, {platform.system()} {platform.release()}",
        "versions": f"Python {platform.python_version()}, " + ", ".join(versions),
        "date": time.strftime("%Y-%m-%d"),
    }


def run(info: DeviceInfo, folder: Path, name: str, quick: bool, stages: Sequence[str]) -> dict[str, Any]:
    """One device on one scene."""
    load = Workload.of(folder, quick)
    rows = [dataclasses.asdict(row) for row in measure(info, load, quick, stages)]
    return {**header(info), "scene": name, "splats": len(load.scene), "rows": rows}


def in_process(info: DeviceInfo, folder: Path, name: str, quick: bool, stages: Sequence[str]) -> dict[str, Any]:
    """The same in a process of its own, which a runtime that crashes takes down alone."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "result.json"
        command = [sys.executable, "-m", "tools.bench.encode", "--one", str(info.index), name, str(folder)]
        command += ["--json", str(path), "--stages", *stages, *(["--quick"] if quick else [])]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            return {**header(info), "scene": name, "rows": [], "failed": done.returncode}
        result: dict[str, Any] = json.loads(path.read_text())
        return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", help="default: lego and plush, or the excerpt if quick")
    parser.add_argument("--device", help="as everywhere; default: all, or the best one if quick")
    parser.add_argument("--quick", action="store_true", help="the excerpt at half size, fewer variants")
    parser.add_argument("--stages", nargs="+", choices=tuple(STAGES), default=list(STAGES))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--from", dest="kept", type=Path, nargs="+", help="figures of earlier runs, instead of a run")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        index, name, folder = args.one
        result = run(list_devices()[int(index)], Path(folder), name, args.quick, args.stages)
        args.json.write_text(json.dumps(result))
        return
    if args.kept:
        results = [result for path in args.kept for result in json.loads(path.read_text())]
    else:
        infos = [choose_device(args.device)] if args.device or args.quick else list_devices()
        with tempfile.TemporaryDirectory() as scratch:
            scenes = {folder.name: folder for folder in args.scenes or ()}
            if not scenes and not args.quick:
                scenes = {folder.name: folder for folder in (SCENES / "lego", SCENES / "plush") if folder.exists()}
            scenes = scenes or {"excerpt": excerpt(Path(scratch) / "excerpt")}
            results = [
                {**circumstances(info), **in_process(info, folder, name, args.quick, args.stages)}
                for info in infos
                for name, folder in scenes.items()
            ]
    if args.json:
        args.json.write_text(json.dumps(results, indent=1))
    for result in results:
        print_report(result)
        if "failed" in result:
            print(f"\nFailed, exit code {result['failed']}.")


if __name__ == "__main__":
    main()
