"""Tables of the documentation that are made from the code; python -m tools.make.docs puts them into the pages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from potr_cl.formats.registry import CAMERA_FORMATS, SCENE_FORMATS
from potr_cl.opencl import quirks
from potr_cl.pipeline.presets import DEFAULT, PRESETS, PURPOSE
from potr_cl.stages.code import Code
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit

#: Says of a page that it is made.
NOTICE = "<!-- Made by `python -m tools.make.docs`. Do not edit this page: edit the code that it describes. -->"


def cell(text: str) -> str:
    """Text that stays in one cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])


def quirks_table() -> str:
    """The workarounds of potr_cl/opencl/quirks.py, for docs/architecture.md."""
    rows = [
        (f"`{name}`", *map(cell, (f"{quirk.vendor}, {quirk.versions}", quirk.reason, quirk.still_needed)))
        for name, quirk in quirks.ALL.items()
    ]
    return table(
        ("quirk", "runtime and versions", "what goes wrong without it", "how to see if it is still needed"), rows
    )


#: What users have posted (docs/devices.md), and the kernels whose times a row has.
_REPORTS = Path(__file__).parents[2] / "docs" / "devices"
_KERNELS = ("project", "sort_tiles", "composite", "removal", "refit_sweep", "derivatives", "compact")


def devices_table(reports: Path = _REPORTS) -> str:
    """The devices of the reports in a folder, for docs/devices.md."""
    rows = []
    for path in sorted(reports.glob("*.json")):
        report = json.loads(path.read_text("utf-8"))
        for entry in report["devices"]:
            if "check" in entry:
                said = entry.get("compiler", [])
                system = f"{report['system']}, {report['machine']}"
                told = (
                    entry["name"],
                    f"{entry['platform']}, {entry['driver']}",
                    system,
                    entry["check"],
                    str(len(said)),
                )
                rows.append([*map(cell, told), *(_per_launch(entry.get("times", {}), name) for name in _KERNELS)])
    head = ("device", "runtime and driver", "system", "self-check", "compiler warnings")
    return table((*head, *(f"`{name}`" for name in _KERNELS)), rows)


def _per_launch(times: dict[str, Any], kernel: str) -> str:
    """Milliseconds."""
    return f"{1e3 * times[kernel]['seconds'] / times[kernel]['launches']:.3g}" if kernel in times else ""


def formats_table() -> str:
    """All formats, for docs/formats.md: a table of scenes and one of cameras."""
    scenes = [
        (
            f"{entry.name} ({', '.join(f'`{name}`' for name in (*entry.suffixes, *entry.names))})",
            "yes",
            "no" if entry.save is None else "yes",
            entry.note,
        )
        for entry in SCENE_FORMATS
    ]
    cameras = [(entry.name, "yes", "no", entry.note) for entry in CAMERA_FORMATS]
    columns = ["reads", "writes", "note"]
    return "\n\n".join([table(["scenes", *columns], scenes), table(["cameras", *columns], cameras)])


def presets_table() -> str:
    """The presets, for README.md."""
    lines = ["| preset | pruning iterations | colours | entropy coder | for |", "|---|---|---|---|---|"]
    for name, stages in PRESETS.items():
        by_name = {stage.name: stage for stage in stages}
        prune, compact, refit, code = (by_name[each] for each in ("prune", "compact", "refit", "code"))
        assert isinstance(prune, Prune)
        assert isinstance(refit, Refit)
        assert isinstance(code, Code)
        colours = f"re-fitted together in {refit.steps} steps" if refit.steps else "as they are"
        if compact.on:
            colours = "compacted splat by splat"
        # The paper's steps are stored as plain streams.
        coder = "zstd" if name == "paper" else code.entropy
        coder += f" {code.zstd_level}" if coder == "zstd" else ""
        mark = " (default)" if name == DEFAULT else ""
        lines.append(f"| `{name}`{mark} | {prune.iterations} | {colours} | {coder} | {PURPOSE[name]} |")
    return "\n".join(lines)
