"""Numerical stress of every kernel against float64, on every OpenCL device.

    python -m tools.stress.run [options]

Each stage is judged on what it was given, so that an error belongs to one kernel: projection on the scene, tile lists,
order and compositing on the ellipses that projection left, removal effects on the same, derivatives of pictures on the
scene (tools.stress.derivatives), the ridge on its own systems, the re-fit on small scenes. Inputs (tools.stress.cases):
cases made by hand, and some that hypothesis makes worse and worse.

Beside each error stands what the kernel cannot help: how much the float64 result moves when the numbers that the kernel
gets are rounded to float32 (random relative changes of up to 2^-24, a few draws). An error of a few times that is the
problem's condition; an error of more than LIMIT times that is the kernel's own, "unstable", and is printed as a case
made as small as it goes. Pixels within rounding of a threshold (alpha 1/255, the end of a pixel) or of a tie in depth
are left out where a flip would say nothing; what may not happen anywhere is a value that is not finite.

Every device and kernel family runs in a process of its own. Prints Markdown; --json writes the inputs too, and
--from reads it again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, list_devices
from tools.results import circumstances
from tools.stress.cases import (
    Case,
    RefitCase,
    RidgeCase,
    known_cases,
    known_refits,
    known_ridges,
    refit_problems,
    ridge_systems,
    small_scenes,
)
from tools.stress.measures import (
    GPU_ONLY,
    LIMIT,
    PROMISES,
    WHAT,
    Measures,
    Worst,
    limit,
    note,
    search,
    smallest_failure,
)
from tools.stress.solvers import check_refit, check_ridge
from tools.stress.views import check


def run_device(device: Device, examples: int, only: str = "") -> dict[str, Any]:
    """All cases, then ``examples`` attempts at each measure whose name begins with one of ``only``, with commas."""
    beginnings = tuple(only.split(","))
    worst: dict[str, Worst] = {}

    def view(case: Case) -> Measures:
        return check(device, case)

    def system(case: RidgeCase) -> Measures:
        return check_ridge(device, case)

    def problem(case: RefitCase) -> Measures:
        return check_refit(device, case)

    lists: tuple[tuple[Callable[[Any], Measures], Iterator[Any]], ...] = (
        (view, known_cases()),
        (system, known_ridges()),
        (problem, known_refits()),
    )
    for run, cases in lists:
        for case in cases:
            found = run(case)
            if not any(measure.startswith(beginnings) for measure in found):
                break  # the list is of other kernels
            note(worst, {measure: pair for measure, pair in found.items() if measure.startswith(beginnings)}, case.name)
    searches: dict[str, tuple[Callable[[Any], Measures], st.SearchStrategy[Any]]] = {
        measure: (view, small_scenes()) for measure in WHAT
    }
    searches["ridge"] = system, ridge_systems()
    for measure in ("re-fit: optimum", "re-fit: loss", "same bits: slices"):
        searches[measure] = problem, refit_problems()
    failures = {}
    for measure, (run, strategy) in searches.items():
        if not measure.startswith(beginnings) or (measure in GPU_ONLY and device.family != "gpu"):
            continue
        if examples:
            search(measure, strategy, run, worst, examples)
        if measure in worst and not worst[measure].ratio <= limit(measure):
            smallest = smallest_failure(measure, strategy, run, 10 * examples) if examples else None
            failures[measure] = smallest or worst[measure].ratio_at
    kept = {name: dataclasses.asdict(w) for name, w in worst.items() if name.startswith(beginnings)}
    return {"worst": kept, "failures": failures}


def families(info: DeviceInfo) -> tuple[str, ...]:
    """The kernel families that a device can run: GPU kernels anywhere, row kernels where vectors pay."""
    return ("cpu", "gpu") if info.family == "cpu" else ("gpu",)


def in_process(info: DeviceInfo, family: str, examples: int, only: str = "") -> dict[str, Any]:
    """The run in a process of its own, so that a runtime that crashes is one line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        command = [sys.executable, "-m", "tools.stress.run", "--device", str(info.index), "--family", family]
        command += ["--examples", str(examples), "--only", only, "--json", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            message = done.stderr.strip().splitlines()
            return {"failed": message[-1] if message else f"exit code {done.returncode}"}
        result: dict[str, Any] = json.loads(path.read_text())[0]
        return result


def shortened(name: str) -> str:
    """For a table's cell."""
    return name if len(name) <= 120 else "found: " + name[:60] + " …"


def print_report(results: list[dict[str, Any]]) -> None:
    """Markdown: the worst of every kernel over all devices, then a row for every device and family."""
    sound = [r for r in results if "failed" not in r]
    print("| kernel | error | worst | of it explained by rounding | with | worst ratio | with | inputs |")
    print("|---|---|---|---|---|---|---|---|")
    for measure, what in WHAT.items():
        rows = [r["worst"][measure] for r in sound if measure in r["worst"]]
        if not rows:
            continue
        by_error, by_ratio = (max(rows, key=lambda w: w[key]) for key in ("error", "ratio"))
        print(
            f"| {measure} | {what} | {by_error['error']:.1e} | {by_error['expected']:.1e} "
            f"| {shortened(by_error['at'])} "
            f"| {by_ratio['ratio']:.2g} | {shortened(by_ratio['ratio_at'])} | {sum(w['checked'] for w in rows)} |"
        )
    print("\nWorst error (worst ratio) by device:\n")
    measured = [measure for measure in WHAT if any(measure in r["worst"] for r in sound)]
    print("| device | kernels | " + " | ".join(measured) + " |")
    print("|---" * (len(measured) + 2) + "|")
    for r in results:
        if "failed" in r:
            print(f"| {r['device']} | {r['family']} | failed: {r['failed']}" + " |" * len(measured))
            continue
        found = [r["worst"].get(measure) for measure in measured]
        cells = (f"{w['error']:.0e} ({w['ratio']:.1g})" if w else "" for w in found)
        print(f"| {r['device']} | {r['family']} | " + " | ".join(cells) + " |")
    failures = [(r, *failure) for r in sound for failure in r["failures"].items()]
    print(
        f"\nBeyond {LIMIT:g} times what rounding explains, or beyond the promise ({', '.join(PROMISES)}): "
        f"{len(failures) or 'none'}."
    )
    for r, measure, name in failures:
        print(f"\n- {measure} on {r['device']}, {r['family']} kernels: {name}")


def main() -> None:
    os.environ.setdefault("RUSTICL_ENABLE", "llvmpipe")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", type=int, help="index of one device; default: every one there is")
    parser.add_argument("--family", choices=("cpu", "gpu"), help="one family of kernels; default: all that run")
    parser.add_argument("--examples", type=int, default=100, help="attempts of the search at every measure")
    parser.add_argument("--only", default="", metavar="PREFIX,…", help="measures whose names begin so, such as fit")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--from", dest="kept", type=Path, nargs="+", help="results of earlier runs, instead of a run")
    args = parser.parse_args()
    if args.kept:
        print_report([result for path in args.kept for result in json.loads(path.read_text())])
        return
    results = []
    chosen = [info for info in list_devices() if args.device in (None, info.index)]
    for info in chosen:
        for family in families(info):
            if args.family not in (None, family):
                continue
            if args.device is None:
                result = in_process(info, family, args.examples, args.only)
            else:
                result = run_device(Device(info, family=family), args.examples, args.only)  # type: ignore[arg-type]
            results.append({**circumstances(info), "device": str(info), "family": family, **result})
            print(f"{info}, {family} kernels: done", file=sys.stderr, flush=True)
            if args.json is not None:
                args.json.write_text(json.dumps(results, indent=1))
    print_report(results)


if __name__ == "__main__":
    main()
