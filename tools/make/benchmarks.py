"""The pages of docs/benchmarks from the results beside them: their tables, their plots, README's table of figures.

    python -m tools.make.benchmarks                  fill the tables, draw the plots (needs the extra "bench")
    python -m tools.make.benchmarks --check          write nothing; fail and say what is stale
    python -m tools.make.benchmarks --take TABLES.json FILE [NAME[=AS] …] [--remark TEXT]

The pages are prose with markers: between ``<!-- table: encode/stages -->`` and ``<!-- end -->`` stands the result
"stages" of docs/benchmarks/results/encode.json, with its title and a line with its machine, date, commit and command.
--take puts tables that a tool kept with --json (:mod:`tools.results`) into FILE.json there, all or those named, in
place of what has that name (or the name AS), whose title stays.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import itertools
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from PIL import Image

from tools.results import ROOT, Cell, Column, markdown, write_json

PAGES, IMAGES = ROOT / "docs" / "benchmarks", ROOT / "docs" / "images"
RESULTS = PAGES / "results"
SCENES = ("lego", "plush")
_BLOCK = re.compile(r"<!-- table: (?P<name>\S+) -->\n.*?<!-- end -->", re.DOTALL)


class ResultError(ValueError):
    """A result, or a page that uses one, is wrong; says where and what."""


@dataclasses.dataclass(frozen=True)
class Result:
    """One measurement.

    Attributes:
        title: what is measured, of what.
        machine, date, commit, command: where, when and by what; of several commands one is run after the other.
        columns, rows: the figures, a row a list with a cell for each column.
        remark: what else a reader must know, a sentence.
    """

    title: str
    machine: str
    date: str
    command: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    commit: str = ""
    remark: str = ""

    def records(self) -> list[dict[str, Any]]:
        """Each row as a dictionary by columns' names."""
        return [dict(zip([column.name for column in self.columns], row, strict=True)) for row in self.rows]

    def row(self, **wanted: Any) -> dict[str, Any]:
        """The only row with these cells.

        Raises:
            ResultError: there is no such row, or more than one.
        """
        rows = [row for row in self.records() if all(row[key] == value for key, value in wanted.items())]
        if len(rows) != 1:
            raise ResultError(f"'{self.title}' has {len(rows)} rows with {wanted}, not one")
        return rows[0]

    def markdown(self) -> str:
        """Title, table, and the line that says what it is of."""
        heads = [column.head for column in self.columns]
        rows = ([column.text(cell) for column, cell in zip(self.columns, row, strict=True)] for row in self.rows)
        about = [self.machine, self.date or "date unknown", *([f"commit {self.commit}"] if self.commit else [])]
        line = ", ".join(about) + (": " + ", then ".join(f"`{each}`" for each in self.command) if self.command else "")
        remark = f" {self.remark}" if self.remark else ""
        return f"**{self.title}**\n\n{markdown(heads, rows)}\n\n*{line}.{remark}*"


Results = dict[str, Result]


def load(folder: Path | None = None) -> Results:
    """All results of a folder, docs/benchmarks/results by default, by "file/name".

    Raises:
        ResultError: one of them is not what a result must be.
    """
    found = {}
    for path in sorted((folder or RESULTS).glob("*.json")):
        for name, raw in json.loads(path.read_text("utf-8")).items():
            try:
                columns = tuple(Column(**each) for each in raw["columns"])
                rows, command = tuple(map(tuple, raw["rows"])), tuple(raw["command"])
                found[f"{path.stem}/{name}"] = Result(**{**raw, "columns": columns, "rows": rows, "command": command})
            except (TypeError, KeyError) as error:
                raise ResultError(f"{path.name}, '{name}': {error}") from error
            for number, row in enumerate(rows, 1):
                if len(row) != len(columns):
                    said = f"row {number} has {len(row)} cells, there are {len(columns)} columns"
                    raise ResultError(f"{path.name}, '{name}': {said}")
    return found


# ------------------------------------------------------------------------------------------------ pages


def filled_pages(results: Results) -> dict[Path, str]:
    """Every page's text with its tables filled in.

    Raises:
        ResultError: a page asks for a result that is not there.
    """

    def fill(match: re.Match[str], path: Path) -> str:
        name = match["name"]
        if name not in results:
            raise ResultError(f"{path}: there is no result '{name}' in {RESULTS}")
        return f"<!-- table: {name} -->\n\n{results[name].markdown()}\n\n<!-- end -->"

    return {path: _BLOCK.sub(partial(fill, path=path), path.read_text("utf-8")) for path in sorted(PAGES.glob("*.md"))}


def problems(results: Results) -> list[str]:
    """What is stale or wrong, a line each."""
    found = []
    pages = filled_pages(results)
    shown = {match["name"] for text in pages.values() for match in _BLOCK.finditer(text)}
    for path, text in pages.items():
        if path.read_text("utf-8") != text:
            found.append(f"{path}: stale, run python -m tools.make.benchmarks")
    found += [f"{RESULTS}: no page shows '{name}'" for name in sorted(results.keys() - shown)]
    stale = [plot for plot in PLOTS if plot.kept_digest() != plot.digest(results)]
    return found + [f"{plot.path}: drawn of other figures, run python -m tools.make.benchmarks" for plot in stale]


_GPU, _CPU = "NVIDIA H200, 16 processors", "Intel's CPU runtime, 2 processors"
#: Scenes as README's table calls them.
_NAMES = {"lego": "lego (NeRF-Synthetic)", "plush": "plush (captured)"}


def figures_table() -> str:
    """The table at the beginning of the README: sizes, losses and times at quality 0.5, of the same commands."""
    results = load()
    commands = results["whole_commands/commands"]
    heads = ("at quality 0.5", "PLY", "`.potr`", "", "PSNR against uncompressed", "lost on the photographs")
    rows = []
    for preset in ("best", "smallest"):
        for scene, name in _NAMES.items():
            uncompressed = results["rate_distortion/uncompressed"].row(scene=scene)
            file = commands.row(scene=scene, preset=preset, device=_GPU)
            rows.append([
                name if preset == "best" else f"{scene}, `--preset {preset}`",
                f"{uncompressed['PLY bytes'] / 1e6:.1f} MB",
                f"{file['bytes'] / 1e6:.2f} MB",
                f"{uncompressed['PLY bytes'] / file['bytes']:.0f} × smaller",
                f"{file['PSNR on test views']:.1f} dB",
                f"{file['lost on photographs']:.2f} dB of {uncompressed['PSNR against photographs']:.2f}",
                *(_encode_time(commands, scene, preset, device) for device in (_GPU, _CPU)),
            ])  # fmt: skip
    return markdown((*heads, "encoded in, H200", "2 CPU cores"), rows)


def _encode_time(commands: Result, scene: str, preset: str, device: str) -> str:
    try:
        seconds = commands.row(scene=scene, preset=preset, device=device)["encode"]
    except ResultError:
        return ""
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"


# ------------------------------------------------------------------------------------------------ plots

#: Of lines, in turn: colours of falling brightness in print, with a marker and a dash each.
_STYLES: list[dict[str, Any]] = [
    {"color": "#000000", "marker": "o", "ls": "-"},
    {"color": "#0072b2", "marker": "s", "ls": "--"},
    {"color": "#d55e00", "marker": "^", "ls": "-."},
    {"color": "#009e73", "marker": "D", "ls": ":"},
]
#: Of single points: shapes alone.
_SHAPES = ["s", "D", "^", "v", "P", "X", "<", "*", ">"]


@dataclasses.dataclass(frozen=True)
class Plot:
    """A picture of two panels; keeps a digest of the figures that it was drawn of, so that others are noticed.

    Attributes:
        name: of the file, without its suffix.
        title: the question that it answers.
        of: the results that it is drawn of.
        panels: draws what is in it.
    """

    name: str
    title: str
    of: tuple[str, ...]
    panels: Callable[[Results, Sequence[Any]], None]

    @property
    def path(self) -> Path:
        return IMAGES / f"{self.name}.png"

    def digest(self, results: Results) -> str:
        """Of the figures that it is drawn of."""
        figures = [[r.title, [c.name for c in r.columns], r.rows] for r in (results[name] for name in self.of)]
        return hashlib.sha256(json.dumps([self.title, *figures]).encode()).hexdigest()

    def kept_digest(self) -> str:
        """Of the figures that the picture was drawn of; empty without a picture."""
        if not self.path.exists():
            return ""
        with Image.open(self.path) as image:
            return str(image.info.get("Results", ""))

    def draw(self, results: Results) -> None:
        """Write the picture."""
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        with pyplot.rc_context({"font.size": 10, "axes.grid": True, "grid.alpha": 0.3, "lines.markersize": 5}):
            figure, axes = pyplot.subplots(1, 2, figsize=(10, 5))
            self.panels(results, axes)
            figure.suptitle(self.title, fontsize=12)
            entries = (zip(*reversed(axis.get_legend_handles_labels()), strict=True) for axis in axes)
            handles = dict(itertools.chain.from_iterable(entries))
            columns = 4 if max(map(len, handles)) < 30 else 2
            rows = -(-len(handles) // columns)
            figure.tight_layout(rect=(0, 0.015 + 0.045 * rows, 1, 1))
            figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=columns, fontsize=9)
            figure.savefig(self.path, dpi=120, metadata={"Results": self.digest(results), "Software": None})
            pyplot.close(figure)


def _ticks(axis: Any, ticks: Sequence[float]) -> None:
    axis.set_xscale("log")
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()


def _knobs(name: str, where: str, tables: Mapping[str, str], bytes_shown: tuple[float, float]) -> Plot:
    """Bytes at equal PSNR by time, a line a knob through the defaults at (1, 0); a panel a table, by its title."""

    def panels(results: Results, axes: Sequence[Any]) -> None:
        rows = {table: [row for row in results[table].records() if row["value"] != "default"] for table in tables}
        changes: tuple[dict[str, Any], ...] = ({}, {"mfc": "w"}, {"ls": ":"})
        styles = ({**each, **more} for more in changes for each in _STYLES)
        style_of = dict(zip(dict.fromkeys(row["knob"] for some in rows.values() for row in some), styles, strict=False))
        for (table, title), axis in zip(tables.items(), axes, strict=True):
            for knob in dict.fromkeys(row["knob"] for row in rows[table]):
                turned = [row for row in rows[table] if row["knob"] == knob]
                cells = ((row["time, in that of the default"], row["bytes at equal PSNR"]) for row in turned)
                axis.plot(*zip(*sorted([(1.0, 0.0), *cells]), strict=True), label=knob, lw=1, **style_of[knob])
            axis.plot([1], [0], marker="*", ms=14, color="k", ls="", label="default")
            axis.set(title=title, xlabel="time, in that of the default", ylim=bytes_shown)
            _ticks(axis, (0.6, 0.8, 1, 1.3, 1.6, 2))
        axes[0].set_ylabel("bytes at equal PSNR, %")

    return Plot(name, f"What does each knob cost and bring {where}?", tuple(tables), panels)


def _curves(name: str, title: str, subject: str, series: Sequence[str], against: str, formats: bool = True) -> Plot:
    """PSNR by size, a panel a scene.

    Args:
        subject: file of results.
        series: that get a line each.
        against: "uncompressed" or "photographs".
        formats: whether other formats get a point each.
    """

    def panels(results: Results, axes: Sequence[Any]) -> None:
        others = results["other_formats/sizes"].records()[1:] if formats else []
        for scene, axis in zip(SCENES, axes, strict=True):
            full, rows = results[f"{subject}/uncompressed"].row(scene=scene), results[f"{subject}/{scene}"].records()
            truth = full["PSNR against photographs"]
            for each, style in zip(series, _STYLES, strict=True):
                own = [row for row in rows if row["preset"] == each]
                axis.plot([r["size"] for r in own], [r[f"PSNR against {against}"] for r in own], label=each, **style)
            for row, shape in zip(others, _SHAPES, strict=False):
                value = truth - row[f"{scene}: lost"] if against == "photographs" else row[f"{scene}: PSNR"]
                label = row["format"].replace("`", "").replace(", 1000 iterations on the photographs", ", fine-tuned")
                axis.plot(row[f"{scene}: size"], value, marker=shape, ms=8, ls="", mfc="w", mec="0.25", label=label)
            if against == "photographs":
                axis.axhline(truth, color="0.5", ls=":", label="uncompressed")
            _ticks(axis, (0.5, 1, 2, 4, 8, 16))
            axis.set(title=f"{scene}, {full['PLY bytes'] / 1e6:.1f} MB as PLY", xlabel="MB")
            if not formats:
                axis.set_ylim(bottom=truth - 1.6)  # below this a file is smaller than anybody asks for
        axes[0].set_ylabel(f"PSNR against the {against}{' renders' * (against == 'uncompressed')}, dB")

    of = tuple(f"{subject}/{each}" for each in (*SCENES, "uncompressed"))
    return Plot(name, title, of + ("other_formats/sizes",) * formats, panels)


def _gpus(results: Results, axes: Sequence[Any]) -> None:
    """Whole commands by the number of GPUs: seconds by part, and times as fast as one."""
    rows = results["scaling/gpu_points"].records()
    names = [f"{row['splats'] / 1e6:.0f} M\n{row['devices']}" for row in rows]
    parts = [name for name in list(rows[0])[4:] if all(isinstance(row[name], float) for row in rows)]
    parts = [name for name in parts[: parts.index("judging") + 1] if any(row[name] for row in rows)]
    bottom = [0.0] * len(rows)
    for number, part in enumerate(parts):
        heights = [row[part] for row in rows]
        grey = str(0.15 + 0.75 * number / len(parts))
        axes[0].bar(names, heights, bottom=bottom, label=part, color=grey, edgecolor="k", lw=0.5)
        bottom = [low + height for low, height in zip(bottom, heights, strict=True)]
    axes[0].set_axisbelow(True)
    axes[0].set(title="seconds by part", xlabel="million splats, GPUs", ylabel="s")
    told = [row for row in results["scaling/gpu_foretold"].records() if row["times as fast as one"]]
    for splats, style in zip(dict.fromkeys(row["splats"] for row in told), _STYLES, strict=False):
        own = [(row["devices"], row["times as fast as one"]) for row in told if row["splats"] == splats]
        axes[1].plot(*zip(*own, strict=True), label=f"{splats / 1e6:.0f} million splats", **style)
    axes[1].plot([1, 4], [1, 4], color="0.5", ls=":", label="if all were shared out")
    axes[1].set(title="times as fast as one", xlabel="GPUs")
    axes[1].set_xticks([1, 2, 4])
    axes[1].legend(loc="upper left", fontsize=9)


_PRESETS = ("best", "fast", "paper", "smallest")
_FITTED = ("paper", "best", "smallest", "smallest with photographs")
_NEAR = "How near does a file of a size come to the {}?"
PLOTS: tuple[Plot, ...] = (
    *(
        _curves(f"rate_distortion_{to}", _NEAR.format(called), "rate_distortion", _PRESETS, to)
        for to, called in (("uncompressed", "uncompressed scene"), ("photographs", "photographs"))
    ),
    _curves(
        "photographs", "What does a fit to photographs bring, on photographs that nobody has looked at?",
        "photographs", _FITTED, "photographs", formats=False,
    ),
    _knobs("time_error", "on a GPU", {"time_error/lego_h200": "lego", "time_error/plush_h200": "plush"}, (-3, 10)),
    _knobs(
        "time_error_cpu",
        "on a CPU",
        {"time_error/lego_cpu": "lego, small views", "time_error/lego_cpu_smallest": "the same, smallest"},
        (-8, 15),
    ),
    _knobs(
        "time_error_fast",
        "in presets fast and paper",
        {"time_error/lego_h200_fast": "lego, GPU", "time_error/lego_cpu_fast": "lego, small views, CPU"},
        (-8, 15),
    ),
    Plot("gpus", "What do more GPUs bring?", ("scaling/gpu_points", "scaling/gpu_foretold"), _gpus),
)  # fmt: skip


# ----------------------------------------------------------------------------------------------- results


def take(tables: Path, subject: str, names: Sequence[str], remark: str = "") -> None:
    """Put tables that a tool has kept into a file of results; the titles that stand there stay."""
    taken, path = json.loads(tables.read_text("utf-8")), RESULTS / f"{subject}.json"
    content = json.loads(path.read_text("utf-8")) if path.exists() else {}
    for name, _, other in (each.partition("=") for each in names or taken):
        target = other or name
        title = content.get(target, taken[name])["title"]
        content[target] = {**taken[name], "title": title, **({"remark": remark} if remark else {})}
    write_json(path, content)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, fail if a page or a plot is stale")
    parser.add_argument("--take", nargs="+", metavar="TABLES.json FILE NAME[=AS]", help="take results of a tool first")
    parser.add_argument("--remark", default="", help="of the results that are taken")
    args = parser.parse_args()
    if args.take:
        tables, subject, *names = args.take
        take(Path(tables), subject, names, args.remark)
    results = load()
    if args.check:
        found = problems(results)
        print("\n".join(found), file=sys.stderr)
        sys.exit(1 if found else 0)
    for path, text in filled_pages(results).items():
        path.write_text(text, "utf-8")
    for plot in PLOTS:
        if plot.kept_digest() != plot.digest(results):
            plot.draw(results)


if __name__ == "__main__":
    main()
