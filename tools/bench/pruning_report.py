"""What tools.bench.pruning has measured, as Markdown tables (:func:`print_results`) and as pictures (:func:`plot`)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

#: The losses at which methods are compared: in dB against the photographs, or PSNR against the uncompressed renders.
LOSS_LEVELS = (0.4, 2.0)
PSNR_LEVELS = (45.0, 40.0)
ONE_ORDER = "one order"


def print_results(results: Row) -> None:
    """All tables."""
    for name, found in results["scenes"].items():
        print(f"\n## {name}: {found['splats']:,} splats, {found['train']} training and {found['test']} test views")
        print(f"\n{results['device']}")
        for part, printer in (("curves", print_curves), ("skips", print_skips), ("frames", print_frames)):
            if part in found:
                print(f"\n### {part}\n")
                printer(found[part])


def _at(rows: Sequence[Row], level: float) -> float | None:
    """The share removed at which a curve's loss reaches ``level`` dB, by interpolation from nothing removed."""
    points = [(0.0, 0.0), *sorted((r["removed"], r["loss"]) for r in rows)]
    for (share0, loss0), (share1, loss1) in itertools.pairwise(points):
        if loss0 <= level < loss1:
            return float(share0 + (share1 - share0) * (level - loss0) / (loss1 - loss0))
    return None


def print_curves(rows: Sequence[Row]) -> None:
    """PSNR and loss by method and share."""
    shares = sorted({r["removed"] for r in rows})
    methods = list(dict.fromkeys(r["method"] for r in rows))
    truth = "loss" in rows[0]
    print("| removed | " + " | ".join(f"{s:.0%}" for s in shares) + (" | kept at 0.4 dB |" if truth else " |"))
    print("|---" * (len(shares) + 1 + truth) + "|")
    for method in methods:
        mine = {r["removed"]: r for r in rows if r["method"] == method}
        cells = [
            f"{mine[s]['psnr']:.1f}" + (f" / {mine[s]['loss']:.2f}" if truth else "") if s in mine else ""
            for s in shares
        ]
        if truth:
            removed = _at(list(mine.values()), LOSS_LEVELS[0])
            cells.append("" if removed is None else f"{1 - removed:.1%}")
        print(f"| {method} | " + " | ".join(cells) + " |")


def pareto(rows: Sequence[Row]) -> list[Row]:
    """The rows that no other beats in both time and PSNR at equal count, by ascending time."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda r: (r["seconds"], -r["psnr_at_equal_count"])):
        if not front or row["psnr_at_equal_count"] > front[-1]["psnr_at_equal_count"]:
            front.append(row)
    return front


def print_skips(rows: Sequence[Row]) -> None:
    """Cost and error of each setting; those on the Pareto front in bold."""
    front = {r["skipped"] for r in pareto(rows)}
    full = rows[0]
    truth = "loss" in full
    print(
        "| skipped | iterations | s | of it preparing | full sweeps | kept | PSNR |"
        + (" loss by photo |" if truth else "")
        + " PSNR at equal count | against the full computation | on training views |"
    )
    print("|---" * (10 + truth) + "|")
    for r in rows:
        name = f"**{r['skipped']}**" if r["skipped"] in front else r["skipped"]
        print(
            f"| {name} | {r['iterations']} | {r['seconds']:.2f} | {r['prepare_seconds']:.2f} | {r['sweeps']:.1f} | "
            f"{r['kept']:,} | {r['psnr']:.2f} | "
            + (f"{r['loss']:.3f} | " if truth else "")
            + f"{r['psnr_at_equal_count']:.2f} | {r['psnr_at_equal_count'] - full['psnr_at_equal_count']:+.2f} | "
            f"{r['train_psnr_at_equal_count'] - full['train_psnr_at_equal_count']:+.2f} |"
        )


def print_frames(rows: Sequence[Row]) -> None:
    """Splats, tile intersections and frame rates at equal loss."""
    truth = any("loss" in r for r in rows)
    unit = "dB lost against the photographs" if truth else "dB against the uncompressed renders"
    print(f"| {unit} | order | found | kept | tile intersections a view | frames/s | against unpruned |")
    print("|---" * 7 + "|")
    for r in rows:
        unpruned = next(u for u in rows if u["level"] == r["level"] and u["method"] == "unpruned")
        found = f"{r['loss' if truth else 'psnr']:.2f}" if "psnr" in r else ""
        print(
            f"| {r['level']:g} | {r['method']} | {found} | {r['kept']:,} | {r['intersections']:,.0f} | "
            f"{r['frames_per_second']:.0f} | {r['frames_per_second'] / unpruned['frames_per_second']:.2f} |"
        )


def plot(results: Row, folder: Path) -> None:
    """All pictures that the results have the rows for."""
    import matplotlib

    matplotlib.use("Agg")
    scenes = results["scenes"]
    folder.mkdir(parents=True, exist_ok=True)
    with_curves = {n: s for n, s in scenes.items() if "curves" in s}
    with_skips = {n: s for n, s in scenes.items() if "skips" in s}
    if with_curves:
        plot_curves(with_curves, "psnr", "PSNR against the uncompressed renders (dB)", folder / "pruning_curves.png")
        if all("loss" in s["curves"][0] for s in with_curves.values()):
            plot_curves(with_curves, "loss", "dB lost against the photographs", folder / "pruning_loss.png")
    if with_skips:
        plot_skips(with_skips, results["device"], folder / "pruning_skips.png")


def plot_curves(scenes: Row, key: str, label: str, path: Path) -> None:
    """The paper's figure: quality against the share removed, a panel a scene."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(scenes), figsize=(6 * len(scenes), 4.6), squeeze=False)
    for axis, (name, found) in zip(axes[0], scenes.items(), strict=True):
        rows = found["curves"]
        methods = [m for m in dict.fromkeys(r["method"] for r in rows) if ONE_ORDER not in m]
        ours = [m for m in methods if m.startswith("ours")]
        shades = pyplot.get_cmap("Blues")(np.linspace(0.4, 1, len(ours)))
        for method in methods:
            mine = sorted((100 * r["removed"], r[key]) for r in rows if r["method"] == method)
            style: Row = {"marker": ".", "linestyle": "--", "linewidth": 1}
            if method in ours:
                style = {"marker": "o", "markersize": 3.5, "color": shades[ours.index(method)]}
            axis.plot(*zip(*mine, strict=True), label=method, **style)
        axis.set_title(f"{name}, {found['splats']:,} splats")
        axis.set_xlabel("% of the splats removed")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        if key == "loss":
            axis.set_ylim(4, -0.2)
    axes[0, -1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def plot_skips(scenes: Row, device: str, path: Path) -> None:
    """Time against loss at equal count, with the Pareto front; the points are numbered."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(scenes), figsize=(7.5 * len(scenes), 5), squeeze=False)
    for axis, (name, found) in zip(axes[0], scenes.items(), strict=True):
        rows, front = found["skips"], pareto(found["skips"])
        full = rows[0]["psnr_at_equal_count"]
        points = [(r["seconds"], full - r["psnr_at_equal_count"]) for r in front]
        axis.plot(*zip(*points, strict=True), "-", color="0.6", linewidth=1, zorder=0)
        for number, r in enumerate(rows, 1):
            point = r["seconds"], full - r["psnr_at_equal_count"]
            axis.plot(*point, "o", color="C0" if r in front else "C1", markersize=4, label=f"{number}  {r['skipped']}")
            axis.annotate(str(number), point, (3, 3), textcoords="offset points", fontsize=8)
        axis.axhline(0, color="0.8", linewidth=0.8, zorder=0)
        axis.set_title(f"{name}, q = 0.5, at {rows[0]['kept']:,} splats\n{device}; Pareto front in blue", fontsize=9)
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=0.5)
        axis.set_xlabel("seconds, preparation included")
        axis.set_ylabel("dB lost against the full computation (test views)")
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1), title="skipped", title_fontsize=8)
        axis.grid(alpha=0.3, which="both")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
