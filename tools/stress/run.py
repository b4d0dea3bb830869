"""Numerical stress of every kernel against float64, on every OpenCL device.

    python -m tools.stress.run [options]

Each stage is judged on what it was given, so that an error belongs to one kernel: projection on the scene, tile lists,
order and compositing on the ellipses that projection left, removal effects on the same, derivatives of pictures on the
scene (tools.stress.fits), the ridge on its own systems, the re-fit on small scenes. Inputs (tools.stress.cases):
cases made by hand, and views that hypothesis makes worse and worse.

Beside each error stands what the kernel cannot help: how much the float64 result moves when the numbers that the kernel
gets are rounded to float32 (random relative changes of up to 2^-24, a few draws). An error of a few times that is the
problem's condition; an error of more than LIMIT times that is the kernel's own, "unstable", and is printed as a case
made as small as it goes. Pixels within rounding of a threshold (alpha 1/255, the end of a pixel) or of a tie in depth
are left out where a flip would say nothing; what may not happen anywhere is a value that is not finite.

Every device and kernel family runs in a process of its own.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family, list_devices
from tools.results import Column, Results
from tools.stress.cases import known_cases, known_refits, known_ridges, small_scenes
from tools.stress.measures import LIMIT, PROMISES, WHAT, Measures, Worst, limit, note, search, smallest_failure
from tools.stress.platforms import families
from tools.stress.solvers import check_refit, check_ridge
from tools.stress.views import check
from tools.workloads import in_process, log, plain_parser


def run_device(device: Device, examples: int, only: str = "") -> dict[str, Any]:
    """All cases, then ``examples`` attempts at each measure whose name begins with one of ``only``, with commas."""
    beginnings = tuple(only.split(","))
    worst: dict[str, Worst] = {}
    kinds: list[tuple[Callable[[Any], Measures], Iterable[Any], Sequence[str]]] = [
        (partial(check, device), known_cases(), [m for m in WHAT if not m.startswith(("ridge", "re-fit"))]),
        (partial(check_ridge, device), known_ridges(), ["ridge"]),
        (partial(check_refit, device), known_refits(), ["re-fit: optimum", "re-fit: loss"]),
    ]
    for run, cases, measures in kinds:
        for case in cases if any(measure.startswith(beginnings) for measure in measures) else ():
            note(worst, {m: pair for m, pair in run(case).items() if m.startswith(beginnings)}, case.name)
    failures = {}
    view, _, of_views = kinds[0]
    for measure in filter(lambda measure: measure.startswith(beginnings), WHAT):
        searched = bool(examples) and measure in of_views
        if searched:
            search(measure, small_scenes(), view, worst, examples)
        if measure in worst and not worst[measure].ratio <= limit(measure):
            smallest = smallest_failure(measure, small_scenes(), view, 10 * examples) if searched else None
            failures[measure] = smallest or worst[measure].ratio_at
    kept = {name: dataclasses.asdict(w) for name, w in worst.items() if name.startswith(beginnings)}
    return {"worst": kept, "failures": failures}


def shortened(name: str) -> str:
    """For a table's cell."""
    return name if len(name) <= 120 else "found: " + name[:60] + " …"


def report(results: Results, runs: list[dict[str, Any]]) -> None:
    """The worst of every kernel over all devices, a row for every device and family, and what is a fault."""
    sound = [run for run in runs if "failed" not in run]
    table = results.table(
        "kernels", "The worst of every kernel",
        "kernel; error; worst||.1e; of it explained by rounding||.1e; with; worst ratio||.2g; with this; inputs",
    )  # fmt: skip
    measured = [measure for measure in WHAT if any(measure in run["worst"] for run in sound)]
    for measure in measured:
        rows = [run["worst"][measure] for run in sound if measure in run["worst"]]
        error, ratio = (max(rows, key=lambda w: w[key]) for key in ("error", "ratio"))
        table.add(
            measure, WHAT[measure], error["error"], error["expected"], shortened(error["at"]), ratio["ratio"],
            shortened(ratio["ratio_at"]), sum(row["checked"] for row in rows),
        )  # fmt: skip
    table = results.table(
        "devices", "Worst error (worst ratio) by device", "device; kernels; failed", *map(Column, measured)
    )
    for run in runs:
        found = [run.get("worst", {}).get(measure) for measure in measured]
        cells = (f"{w['error']:.0e} ({w['ratio']:.1g})" if w else None for w in found)
        table.add(run["device"], run["family"], run.get("failed", ""), *cells)
    title = f"Beyond {LIMIT:g} times what rounding explains, or beyond the promise ({', '.join(PROMISES)})"
    table = results.table("failures", title, "kernel; device; kernels; smallest input that was found")
    for run in sound:
        for measure, name in run["failures"].items():
            table.add(measure, run["device"], run["family"], name)


def on_device(index: int, family: Family, examples: int, only: str) -> dict[str, Any]:
    """The run on one device of the list."""
    return run_device(Device(list_devices()[index], family=family), examples, only)


def main() -> None:
    os.environ.setdefault("RUSTICL_ENABLE", "llvmpipe")
    parser = plain_parser(__doc__)
    parser.add_argument("--device", type=int, help="index of one device; default: every one there is")
    parser.add_argument("--family", choices=("cpu", "gpu"), help="one family of kernels; default: all that run")
    parser.add_argument("--examples", type=int, default=100, help="attempts of the search at every measure")
    parser.add_argument("--only", default="", metavar="PREFIX,…", help="measures whose names begin so, such as fit")
    args = parser.parse_args()
    runs: list[dict[str, Any]] = []
    chosen = [info for info in list_devices() if args.device in (None, info.index)]
    for info, family in ((each, family) for each in chosen for family in families(each)):
        if args.family in (None, family):
            try:
                found = in_process(on_device, info.index, family, args.examples, args.only)
            except Exception as error:  # whatever a runtime does
                found = {"failed": (str(error).splitlines() or [type(error).__name__])[-1]}
            runs.append({"device": str(info), "family": family, **found})
            log(f"{info}, {family} kernels: done")
    report(Results(None, args.json), runs)


if __name__ == "__main__":
    main()
