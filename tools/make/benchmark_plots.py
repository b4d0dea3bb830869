"""The plots of docs/benchmarks, drawn of its results alone: each answers the question that its title asks.

A picture keeps a digest of the figures that it was drawn of, so that :func:`stale` finds those that changed since
without drawing anything. Lines and points differ by marker and dash, not by colour alone, to be read in print.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tools.make.benchmark_results import ROOT, Result, package_defaults

IMAGES = ROOT / "docs" / "images"
SCENES = ("lego", "plush")

#: Of lines, in turn: colours of falling brightness in print, with a marker and a dash each.
_STYLES: list[dict[str, Any]] = [
    {"color": "#000000", "marker": "o", "ls": "-"},
    {"color": "#0072b2", "marker": "s", "ls": "--"},
    {"color": "#d55e00", "marker": "^", "ls": "-."},
    {"color": "#009e73", "marker": "D", "ls": ":"},
    {"color": "#cc79a7", "marker": "v", "ls": (0, (5, 1))},
    {"color": "#7f7f7f", "marker": "P", "ls": (0, (1, 1))},
    {"color": "#e69f00", "marker": "X", "ls": (0, (3, 1, 1, 1))},
    {"color": "#56b4e9", "marker": "*", "ls": (0, (7, 2))},
]
_PRESETS = ("best", "fast", "paper", "smallest")
#: Of single points: shapes alone.
_SHAPES = ["s", "D", "^", "v", "P", "X", "<", "*", ">"]

Results = dict[str, Result]


@dataclass(frozen=True)
class Plot:
    """One picture.

    Attributes:
        name: of the file, without its suffix.
        results: names of the results that it is drawn of.
        draw: draws it into a figure that has a panel for each scene (or as many as ``panels`` says).
        title: the question that it answers.
        panels: how many, side by side.
        share_y: whether the panels have one axis of ordinates.
    """

    name: str
    results: tuple[str, ...]
    draw: Callable[[Results, Sequence[Any]], None]
    title: str
    panels: int = 2
    share_y: bool = False

    @property
    def path(self) -> Path:
        return IMAGES / f"{self.name}.png"

    def digest(self, results: Results) -> str:
        """Of the figures that it is drawn of."""
        figures = [[r.title, [c.name for c in r.columns], r.rows] for r in (results[name] for name in self.results)]
        return hashlib.sha256(json.dumps([self.title, *figures]).encode()).hexdigest()


def draw_all(results: Results) -> list[Path]:
    """Draw the pictures that are stale; returns their files. Needs matplotlib."""
    return [_draw(plot, results) for plot in PLOTS if _kept_digest(plot) != plot.digest(results)]


def stale(results: Results) -> list[str]:
    """A line for each picture that was drawn of other figures, or never."""
    return [
        f"{plot.path}: drawn of other figures, run python -m tools.make.benchmark_pages"
        for plot in PLOTS
        if _kept_digest(plot) != plot.digest(results)
    ]


def _kept_digest(plot: Plot) -> str:
    if not plot.path.exists():
        return ""
    with Image.open(plot.path) as image:
        return str(image.info.get("Results", ""))


def _draw(plot: Plot, results: Results) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with pyplot.rc_context({"font.size": 10, "axes.grid": True, "grid.alpha": 0.3, "lines.markersize": 5}):
        figure, axes = pyplot.subplots(1, plot.panels, figsize=(10, 5), sharey=plot.share_y, squeeze=False)
        plot.draw(results, axes[0])
        figure.suptitle(plot.title, fontsize=12)
        labelled = dict(
            pair for axis in axes[0] for pair in zip(*reversed(axis.get_legend_handles_labels()), strict=True)
        )
        # The legend stands below the panels, where it can hide nothing.
        columns = 4 if max(map(len, labelled), default=0) < 28 else 3
        rows = math.ceil(len(labelled) / columns)
        figure.tight_layout(rect=(0, 0.015 + 0.045 * rows, 1, 1))
        if labelled:
            figure.legend(list(labelled.values()), list(labelled), loc="lower center", ncols=columns, fontsize=9)
        figure.savefig(plot.path, dpi=120, metadata={"Results": plot.digest(results), "Software": None})
        pyplot.close(figure)
    return plot.path


def _plain_log(axis: Any, which: str, ticks: Sequence[float]) -> None:
    """A logarithmic axis whose ticks are plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    getattr(axis, f"set_{which}scale")("log")
    one = getattr(axis, f"{which}axis")
    one.set_major_locator(FixedLocator(ticks))
    one.set_minor_locator(NullLocator())
    one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _rate_distortion(results: Results, axes: Sequence[Any], against: str, other: str) -> None:
    """Quality by size: a line for each preset, a point for each other format."""
    full = {row["scene"]: row for row in results["rate_distortion/uncompressed"].records()}
    for scene, axis in zip(SCENES, axes, strict=True):
        rows = results[f"rate_distortion/{scene}"].records()
        for preset, style in zip(_PRESETS, _STYLES, strict=False):
            of_it = [row for row in rows if row["preset"] == preset]
            axis.plot([r["size"] for r in of_it], [r[f"PSNR against {against}"] for r in of_it], label=preset, **style)
        for row, shape in zip(results["other_formats/sizes"].records()[1:], _SHAPES, strict=False):
            value = row[f"{scene}: {other}"]
            if other == "lost":
                value = full[scene]["PSNR against photographs"] - value
            name = row["format"].replace("`", "").replace(", 1000 iterations on the photographs", ", fine-tuned")
            axis.plot(row[f"{scene}: size"], value, marker=shape, ms=8, ls="", mfc="w", mec="0.25", mew=1.3, label=name)
        if other == "lost":
            axis.axhline(full[scene]["PSNR against photographs"], color="0.5", ls=":", label="uncompressed")
        _plain_log(axis, "x", (0.5, 1, 2, 4, 8, 16))
        axis.set(title=f"{scene}, {full[scene]['PLY bytes'] / 1e6:.1f} MB as PLY", xlabel="MB")
    axes[0].set_ylabel(f"PSNR against {'the photographs' if other == 'lost' else 'the uncompressed renders'}, dB")


#: Of the plot of files that were fitted to photographs.
_FITTED_SERIES = ("paper", "best", "smallest", "smallest with photographs")


def _photographs(results: Results, axes: Sequence[Any]) -> None:
    """PSNR against unseen photographs by size, with a fit to others and without."""
    full = {row["scene"]: row for row in results["photographs/uncompressed"].records()}
    for scene, axis in zip(SCENES, axes, strict=True):
        rows = results[f"photographs/{scene}"].records()
        for series, style in zip(_FITTED_SERIES, _STYLES, strict=False):
            of_it = [row for row in rows if row["preset"] == series]
            axis.plot([r["size"] for r in of_it], [r["PSNR against photographs"] for r in of_it], label=series, **style)
        uncompressed = full[scene]["PSNR against photographs"]
        axis.axhline(uncompressed, color="0.5", ls=":", label="uncompressed")
        _plain_log(axis, "x", (0.5, 1, 2, 4))
        # Below this a file is smaller than anybody asks for.
        axis.set_ylim(bottom=uncompressed - 1.6)
        axis.set(title=f"{scene}, {full[scene]['PLY bytes'] / 1e6:.1f} MB as PLY", xlabel="MB")
    axes[0].set_ylabel("PSNR against the photographs of test views, dB")


def bytes_at(rows: Sequence[dict[str, Any]], psnr: float) -> float:
    """Megabytes at a PSNR against the uncompressed renders, interpolated in the logarithm of the size."""
    points = sorted((row["PSNR against uncompressed"], math.log(row["size"])) for row in rows)
    known, sizes = np.array(points).T
    return math.exp(float(np.interp(psnr, known, sizes)))


def _encode_presets(results: Results, axes: Sequence[Any]) -> None:
    """Bytes at the PSNR of preset best, q = 0.5, by the time of an encode."""
    (axis,) = axes
    seconds = {(row["scene"], row["preset"]): row["in all"] for row in results["encode/stages"].records()}
    for scene, style in zip(SCENES, _STYLES, strict=False):
        rows = results[f"rate_distortion/{scene}"].records()
        timed = [preset for preset in _PRESETS if (scene, preset) in seconds]
        by_preset = {p: [row for row in rows if row["preset"] == p] for p in timed}
        psnr = next(row["PSNR against uncompressed"] for row in by_preset["best"] if row["q"] == 0.5)
        points = sorted((seconds[scene, p], bytes_at(of_it, psnr), p) for p, of_it in by_preset.items())
        label = f"{scene}, at {psnr:.1f} dB against the uncompressed renders"
        axis.plot(*zip(*((x, y) for x, y, _ in points), strict=True), label=label, **{**style, "ls": ""}, ms=9)
        for x, y, preset in points:
            axis.annotate(preset, (x, y), (8, 5), textcoords="offset points")
    axis.set(xlabel="seconds of an encode, NVIDIA H200", ylabel="MB at equal PSNR")
    _plain_log(axis, "x", (0.5, 1, 2, 4, 8))
    axis.set_xlim(0.4, 1.3 * max(seconds.values()))
    axis.set_ylim(0, 1.12 * axis.get_ylim()[1])


def _pruning_curves(results: Results, axes: Sequence[Any]) -> None:
    """PSNR by the part of the splats that is removed, for orders of removal."""
    shown = ("ours, 48 iterations", "ours, 4 iterations", "ours, 1 iteration", "importance", "MesonGS", "LightGaussian")
    for scene, axis in zip(SCENES, axes, strict=True):
        result = results[f"pruning/psnr_{scene}"]
        rows = {row["order"]: row for row in result.records()}
        columns = [column.name for column in result.columns[1:]]
        for order, style in zip((*shown, "opacity", "random"), _STYLES, strict=True):
            values = [rows[order][column] for column in columns]
            axis.plot([int(column.split()[0]) for column in columns], values, label=order, **style)
        axis.set(title=scene, xlabel="% of the splats removed")
    axes[0].set_ylabel("PSNR against the uncompressed renders, dB")


#: Families of the pruning's variants, and which names of their tables belong to each.
_FAMILIES: tuple[tuple[str, Callable[[str], bool]], ...] = (
    ("tile tolerance", lambda name: name.startswith("tolerance") and "decay" not in name),
    ("iterations", lambda name: name.endswith("iterations") and not name.startswith("nothing")),
    ("part of the tiles at random", lambda name: "at random" in name),
    ("views in turns", lambda name: name.startswith("views in")),
    ("fewer views", lambda name: name.startswith("every")),
    ("views of half the size", lambda name: name.startswith("half")),
    ("nothing skipped", lambda name: name == "nothing"),
)


def _pruning_skips(results: Results, axes: Sequence[Any]) -> None:
    """What is lost against the full computation by the time of the schedule, for ways to skip."""
    default = f"tolerance {package_defaults()['tolerance']:g}"
    for scene, axis in zip(SCENES, axes, strict=True):
        rows = results[f"pruning/skips_{scene}"].records()
        for (family, belongs), style in zip(_FAMILIES, _STYLES, strict=False):
            chosen = [row for row in rows if belongs(row["skipped"])]
            xs, ys = [row["time"] for row in chosen], [-row["against the full computation"] for row in chosen]
            line = family in ("tile tolerance", "iterations")
            axis.plot(xs, ys, label=family, **{**style, "ls": style["ls"] if line else ""})
            for row, x, y in zip(chosen, xs, ys, strict=True):
                # The ends of the lines, and the default, tell how to read them.
                if row["skipped"] in ("tolerance 0.002", "tolerance 0.05", default):
                    axis.annotate(row["skipped"].split()[1], (x, y), (7, 4), textcoords="offset points", fontsize=9)
                elif row["skipped"] == "4 iterations":
                    axis.annotate("4", (x, y), (-7, -4), textcoords="offset points", ha="right", fontsize=9)
        axis.axhline(0, color="0.5", lw=0.8)
        axis.set_yscale("symlog", linthresh=0.25)
        axis.set_yticks(
            [-0.1, 0, 0.1, 0.25, 0.5, 1, 2, 4, 8], [f"{v:g}" for v in (-0.1, 0, 0.1, 0.25, 0.5, 1, 2, 4, 8)]
        )
        axis.set_ylim(-0.1, 10)
        axis.set_xlim(0, 0.7)
        axis.set(title=scene, xlabel="seconds of the schedule, NVIDIA H200")
    axes[0].set_ylabel("dB lost against the full computation, equal counts")


def _compaction(results: Results, axes: Sequence[Any]) -> None:
    """What is lost on the photographs by the share of zeros, for thresholds of parallelism."""
    for scene, axis in zip(SCENES, axes, strict=True):
        for pruned, shade in ((False, {}), (True, {"mfc": "w"})):
            rows = results[f"compaction/{scene}{'_pruned' if pruned else ''}"].records()
            start = next(row["PSNR against photographs"] for row in rows if row["variant"] == "no compaction")
            for alpha, style in zip((1, 0.9, 0.7), _STYLES, strict=False):
                chosen = [row for row in rows if row["α"] == alpha and not row["variant"]]
                zeros = [row["AC zeros (degree 1 / 2 / 3)"][0] for row in chosen]
                lost = [start - row["PSNR against photographs"] for row in chosen]
                label = f"α = {alpha:g}, {'pruned' if pruned else 'not pruned'}"
                axis.plot(zeros, lost, label=label, **{**style, **shade})
        axis.set(title=scene, xlabel="AC coefficients that are 0, %")
    axes[0].set_ylabel("dB lost on the photographs")


def _refit(results: Results, axes: Sequence[Any], against: str) -> None:
    """Quality by size for ways to treat the colours of the splats that are left."""
    for scene, axis in zip(SCENES, axes, strict=True):
        rows = results[f"refit/{scene}"].records()
        for way, style in zip(dict.fromkeys(row["colours"] for row in rows), _STYLES, strict=True):
            chosen = [row for row in rows if row["colours"] == way]
            axis.plot([r["size"] for r in chosen], [r[f"PSNR against {against}"] for r in chosen], label=way, **style)
        _plain_log(axis, "x", (0.5, 1, 2, 4))
        axis.set(title=scene, xlabel="MB")
    axes[0].set_ylabel(f"PSNR against the {against}{' renders' if against == 'uncompressed' else ''}, dB")


def _both(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}{scene}" for name in names for scene in SCENES)


_CURVES = (*_both("rate_distortion/"), "rate_distortion/uncompressed", "other_formats/sizes")
PLOTS = (
    Plot(
        "rate_distortion_uncompressed",
        _CURVES,
        partial(_rate_distortion, against="uncompressed", other="PSNR"),
        "How near does a file of a size come to the uncompressed scene?",
    ),
    Plot(
        "rate_distortion_photographs",
        _CURVES,
        partial(_rate_distortion, against="photographs", other="lost"),
        "How near does a file of a size come to the photographs?",
    ),
    Plot(
        "photographs",
        (*_both("photographs/"), "photographs/uncompressed"),
        _photographs,
        "What does a fit to photographs bring, on photographs that nobody has looked at?",
    ),
    Plot(
        "encode_presets",
        ("encode/stages", *_both("rate_distortion/")),
        _encode_presets,
        "How many bytes does each preset take for the same PSNR, and how long?",
        panels=1,
    ),
    Plot(
        "pruning_curves",
        _both("pruning/psnr_"),
        _pruning_curves,
        "Which order of removal keeps the picture?",
    ),
    Plot(
        "pruning_skips",
        _both("pruning/skips_"),
        _pruning_skips,
        "What does a faster pruning schedule lose? (q = 0.5)",
        share_y=True,
    ),
    Plot(
        "compaction_sparsity",
        _both("compaction/") + tuple(f"compaction/{scene}_pruned" for scene in SCENES),
        _compaction,
        "What does it cost to set AC coefficients to 0 splat by splat?",
    ),
    *(
        Plot(
            f"refit_{against}",
            _both("refit/"),
            partial(_refit, against=against),
            f"Which treatment of colours takes the fewest bytes? (against the {what})",
        )
        for against, what in (("uncompressed", "uncompressed renders"), ("photographs", "photographs"))
    ),
)
