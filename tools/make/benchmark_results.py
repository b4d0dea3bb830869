"""Measured results of docs/benchmarks/results/*.json, and the Markdown tables that they become.

A file holds the results of one subject, by name: ``encode.json`` with ``"stages"`` in it is the result "encode/stages".
A result says what was measured, by which command, where and when, and holds its figures as numbers; how a figure is
written is said once, by its column. What follows from other figures (a ratio), and what the package decides (which row
is the default), is worked out here and stored nowhere.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.compact import Compact
from potr_cl.stages.compaction.ridge import CompactionOptions
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "benchmarks" / "results"

#: What a result's options are called in the line under its table.
OPTION_NAMES = {
    "tolerance": "tile tolerance",
    "transmittance_threshold": "transmittance threshold of the removal sweep",
    "decay": "decay of the moving average",
    "iterations": "pruning iterations",
}

#: Known to its tables as a number, a list of numbers (for a column with several in a cell), a text, or nothing.
Cell = Any


class ResultError(ValueError):
    """A result, or a page that uses one, is wrong; says where and what."""


@dataclass(frozen=True)
class Column:
    """A column of a result.

    Attributes:
        name: what stands in the table's head.
        unit: of its numbers; stands in the head, too.
        format: how a number is written: a format specification (".2f"), or, where cells are lists, a text with a
            replacement field for each number ("{:.2f} / {:.2f}"). "time": seconds, written with a fitting prefix.
            "range": one number, or two as "a to b".
        default: what a cell of this column shows if it is of the package's default, as a text with names of
            :func:`package_defaults` ("tolerance {tolerance:g}"). The row that has it in all such columns is marked.
        ratio: names of two columns whose quotient this column shows; its cells are not stored.
        hidden: needed by others, not shown.
        bold: true or false in each row: sets the row's first cell in bold type; not shown.
    """

    name: str
    unit: str = ""
    format: str = ""
    default: str = ""
    ratio: tuple[str, str] | None = None
    hidden: bool = False
    bold: bool = False

    @property
    def head(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}" if self.unit and self.name else self.name or self.unit

    def text(self, cell: Cell) -> str:
        """How a cell is written."""
        if cell is None:
            return ""
        if isinstance(cell, str):
            return cell
        if self.format == "range":
            return " to ".join(str(each) for each in (cell if isinstance(cell, list) else [cell]))
        if isinstance(cell, list):
            return self.format.format(*cell)
        if self.format == "time":
            return _time(cell)
        return str(format(cell, self.format))


@dataclass(frozen=True)
class Result:
    """One measurement: its circumstances and its figures.

    Attributes:
        title: what is measured, of what.
        machine: the device, and the processors beside it.
        date: of the measurement, YYYY-MM-DD, or several; empty if unknown.
        command: what measures it again; several are run one after the other.
        state: "current" if it tells of the code as it is, "history" if of an earlier state.
        commit: of the code that was measured; empty if unknown.
        options: values of options that it was measured with and that were defaults then, by name of
            :func:`package_defaults`. Where a default has changed since, the line under the table says so.
        remark: what else a reader must know, a sentence.
        transpose: rows of the table are the columns here; the given number of first columns make up its head.
        columns, rows: the figures, a row a list with a cell for each stored column.
    """

    title: str
    machine: str
    date: str
    command: tuple[str, ...]
    state: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    commit: str = ""
    options: dict[str, float] = field(default_factory=dict)
    remark: str = ""
    transpose: int = 0

    def values(self, name: str) -> list[Cell]:
        """The cells of one column, derived ones too.

        Raises:
            ResultError: there is no such column.
        """
        stored = [column.name for column in self.columns if column.ratio is None]
        for column in self.columns:
            if column.name == name:
                if column.ratio:
                    pairs = zip(*(self.values(each) for each in column.ratio), strict=True)
                    return [None if a is None or not b else a / b for a, b in pairs]
                return [row[stored.index(name)] for row in self.rows]
        raise ResultError(f"'{self.title}' has no column '{name}'")

    def column(self, name: str) -> Column:
        """A column by its name."""
        return next(column for column in self.columns if column.name == name)

    def records(self) -> list[dict[str, Cell]]:
        """Each row as a dictionary by columns' names."""
        names = [column.name for column in self.columns]
        return [dict(zip(names, row, strict=True)) for row in zip(*map(self.values, names), strict=True)]


def package_defaults() -> dict[str, Any]:
    """The package's defaults, by the names that columns and results know them by."""
    options = EncodeOptions()
    prune = options.stage(Prune)
    return {
        "quality": options.q,
        "preset": options.preset,
        "iterations": prune.iterations,
        "mapping_a": prune.mapping_a,
        "decay": prune.decay,
        "tolerance": prune.tolerance,
        "transmittance_threshold": prune.transmittance_threshold,
        "compact_at": options.stage(Compact).at,
        "precision": CompactionOptions.precision,
        "refit_steps": options.stage(Refit).steps,
    }


def load(folder: Path = RESULTS) -> dict[str, Result]:
    """All results of a folder, by "file/name".

    Raises:
        ResultError: one of them is not what a result must be.
    """
    found = {}
    for path in sorted(folder.glob("*.json")):
        if path.stem == "headlines":
            continue
        for name, raw in json.loads(path.read_text(encoding="utf-8")).items():
            found[f"{path.stem}/{name}"] = checked(f"{path.name}, '{name}'", raw)
    return found


def checked(where: str, raw: dict[str, Any]) -> Result:
    """A result as its file holds it.

    Raises:
        ResultError: it is not what a result must be; ``where`` says which.
    """
    raw = {"state": "current", **raw}
    unknown = set(raw) - {each.name for each in fields(Result)}
    if unknown:
        raise ResultError(f"{where}: '{min(unknown)}' is no part of a result")
    columns = []
    for each in raw["columns"]:
        strange = set(each) - {known.name for known in fields(Column)}
        if strange:
            raise ResultError(f"{where}: '{min(strange)}' is no part of a column")
        columns.append(Column(**{**each, "ratio": tuple(each["ratio"])} if "ratio" in each else each))
    if len({column.name for column in columns}) < len(columns):
        raise ResultError(f"{where}: two columns have the same name")
    stored = sum(column.ratio is None for column in columns)
    for number, row in enumerate(raw["rows"], 1):
        if len(row) != stored:
            raise ResultError(f"{where}: row {number} has {len(row)} cells, there are {stored} columns")
    if raw["state"] not in ("current", "history"):
        raise ResultError(f"{where}: the state is '{raw['state']}', it must be 'current' or 'history'")
    if not re.fullmatch(r"(\d{4}-\d\d-\d\d(, )?)*", raw["date"]):
        raise ResultError(f"{where}: the date is '{raw['date']}', it must be YYYY-MM-DD")
    given = {**raw, "columns": tuple(columns), "rows": tuple(tuple(row) for row in raw["rows"])}
    return Result(**{**given, "command": tuple(raw["command"])})


def table(result: Result) -> str:
    """The result as a Markdown table."""
    columns = [column for column in result.columns if not (column.hidden or column.bold)]
    texts = [[column.text(cell) for cell in result.values(column.name)] for column in columns]
    heads = [column.head for column in columns]
    marked = _default_rows(result)
    bold = next((result.values(column.name) for column in result.columns if column.bold), [False] * len(result.rows))
    for number, strong in enumerate(bold):
        if strong:
            texts[0][number] = f"**{texts[0][number]}**"
    marks = [i for i, column in enumerate(columns) if column.default]
    for number in marked:
        texts[marks[-1]][number] += " (default)"
    if result.transpose:
        n = result.transpose
        names = [", ".join(parts) for parts in zip(*texts[:n], strict=True)]
        return _markdown(["", *names], [[head, *cells] for head, cells in zip(heads[n:], texts[n:], strict=True)])
    return _markdown(heads, [list(row) for row in zip(*texts, strict=True)])


def _default_rows(result: Result) -> list[int]:
    """The rows that are of the package's defaults in every column that tells."""
    telling = [column for column in result.columns if column.default]
    if not telling:
        return []
    defaults = package_defaults()
    rows = set(range(len(result.rows)))
    for column in telling:
        wanted = column.default.format(**defaults)
        rows &= {i for i, cell in enumerate(result.values(column.name)) if column.text(cell) == wanted}
    return sorted(rows)


def _markdown(heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(
        "| " + " | ".join(line) + " |" if line is not lines[1] else "|---" * len(line) + "|" for line in lines
    )


def circumstances(result: Result) -> str:
    """Machine, date and command of a result, and which defaults have changed since, in a line for under its table."""
    commit = f"commit {result.commit}" if result.commit else ""
    parts = [part for part in (result.machine, result.date or "date unknown", commit) if part]
    line = ", ".join(parts)
    if result.command:
        line += ": " + ", then ".join(f"`{command}`" for command in result.command)
    line += "."
    defaults = package_defaults()
    for name, value in result.options.items():
        if value != defaults[name]:
            line += f" Measured with {OPTION_NAMES[name]} {value:g}; the default is {defaults[name]:g} now."
    if result.remark:
        line += f" {result.remark}"
    if result.state == "history":
        line = f"History: {line}"
    return f"*{line}*"


def _time(seconds: float) -> str:
    """Seconds with a fitting prefix, two to three digits."""
    if seconds < 1e-3:
        return f"{seconds * 1e6:.0f} µs"
    if seconds < 1e-2:
        return f"{seconds * 1e3:.1f} ms"
    return f"{seconds * 1e3:.0f} ms" if seconds < 1 else f"{seconds:.2f} s"
