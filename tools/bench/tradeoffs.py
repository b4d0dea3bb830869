"""One variant of a stage, its time and its error (:class:`Row`); tables of many, for tools.bench.encode."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

#: Part by which a time or an error must be lower to be lower.
NOISE = 0.05


@dataclasses.dataclass(frozen=True)
class Row:
    """One variant of one stage.

    Attributes:
        seconds: of the time that the stage's heading names.
        error: of the kind that the stage's heading names.
        default: whether this is what the package does on this device.
        nbytes: of the result, where that is a matter of the variant.
    """

    stage: str
    variant: str
    seconds: float
    error: float
    default: bool = False
    nbytes: int | None = None


#: Every stage's time, and its error.
STAGES = {
    "project": ("a view's projection", "largest error of a centre, pixels"),
    "tile lists": ("a view's tile lists", "intersections that another variant has not"),
    "sort": ("a view's depth sort", "intersections out of order"),
    "composite": ("a view's compositing", "largest error of a pixel"),
    "removal": ("a sweep over all tiles of a view", "median relative error of ΔMSE"),
    "prune": ("the schedule", "RMS error on test views at equal counts"),
    "ridge": ("the kernel, a million splats", "colour error above the optimum, 99.99th percentile"),
    "re-fit": ("the solver", "RMS error on training views"),
    "code": ("coding without looking at views", "bytes"),
    "decode": ("decoding", "bytes"),
    "encode": ("the whole encode", "RMS error on test views"),
}


def on_front(row: Row, rows: Sequence[Row]) -> bool:
    """Whether no other variant is at least as good in all and, beyond what is noise, better in one."""

    def marks(r: Row) -> tuple[float, float, float]:
        return r.seconds, r.error, r.nbytes or 0

    def better(a: float, b: float) -> bool:
        return a < b / (1 + NOISE)

    mine = marks(row)
    pairs = [list(zip(marks(other), mine, strict=True)) for other in rows]
    return not any(all(a <= b for a, b in p) and any(better(a, b) for a, b in p) for p in pairs)


def number(value: float) -> str:
    """Three digits, whatever the size; whole numbers whole."""
    return f"{value:,.0f}" if value == round(value) and abs(value) < 1e12 else f"{value:.3g}"


def print_report(result: dict[str, Any]) -> None:
    """A device's and scene's tables."""
    rows = [Row(**row) for row in result["rows"]]
    print(f"\n### {result['scene']}, {result['device'].split(',')[0]}\n")
    print("; ".join(result[key] for key in ("device", "machine", "versions", "date")) + ".")
    for stage, (what, error) in STAGES.items():
        own = [row for row in rows if row.stage == stage]
        if not own:
            continue
        sized = any(row.nbytes is not None for row in own)
        print(f"\n#### {stage}: seconds of {what}, {error}\n")
        print(f"| variant | seconds | {error} |" + (" bytes |" if sized else "") + " Pareto front |")
        print("|---" * (5 if sized else 4) + "|")
        for row in sorted(own, key=lambda r: r.seconds):
            name = f"**{row.variant}** (default)" if row.default else row.variant
            cells = [name, f"{row.seconds:.3g}", number(row.error)]
            cells += [f"{row.nbytes:,}" if row.nbytes is not None else ""] if sized else []
            print(f"| {' | '.join(cells)} | {'yes' if on_front(row, own) else ''} |")
        for row in own:
            if row.default and not on_front(row, own):
                print(f"\nThe default, {row.variant}, is not on the front.")
