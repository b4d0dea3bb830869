"""Results that say what they are of: tables that a tool prints while it measures, and keeps as JSON.

A result is a title, the machine, the date, the commit and the command that made it, columns and rows of figures::

    {"stages": {"title": …, "machine": …, "date": "2026-01-31", "commit": …, "command": ["python -m tools.bench.fit"],
                "columns": [{"name": "stage"}, {"name": "wall", "unit": "ms", "format": ".0f"}],
                "rows": [["prune", 731.2], …]}}

A file holds the results of one run by name. docs/benchmarks keeps such files and makes its tables of them.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potr_cl.host.atomic_write import replacing

if TYPE_CHECKING:
    from potr_cl.opencl.discovery import DeviceInfo

ROOT = Path(__file__).parents[1]

#: What stands in a table: a number, several in one cell, a text, or nothing.
Cell = float | int | str | None | list[float] | list[int]


class Results:
    """The tables of one run of a tool.

    Args:
        device: what was measured on; None for the processor alone.
        path: where to keep the results as JSON, after every row; None prints only.
        about: where, when and by what they were measured, if not here and now: as :func:`circumstances` gives it.
    """

    def __init__(
        self, device: DeviceInfo | None, path: Path | None = None, about: dict[str, Any] | None = None
    ) -> None:
        known = about or circumstances(device)
        self._circumstances = {name: known[name] for name in ("machine", "date", "command", "commit")}
        self._path = path
        self._tables: dict[str, Table] = {}
        print("{machine}, {date}, commit {commit}".format(**self._circumstances))

    def table(self, name: str, title: str, *given: Column | str) -> Table:
        """Begin a table, with its head on standard output.

        Args:
            name: of the result in the JSON file.
            title: what the table shows, without a full stop.
            given: columns; a text is several, "name; name|unit; name|unit|format".
        """
        columns = tuple(
            column for each in given for column in ([each] if isinstance(each, Column) else Column.of(each))
        )
        print(f"\n{title}:\n\n{markdown([column.head for column in columns], ())}", flush=True)
        self._tables[name] = Table(title, columns, self._keep)
        return self._tables[name]

    def _keep(self) -> None:
        if self._path is not None:
            write_json(self._path, {name: table.content(self._circumstances) for name, table in self._tables.items()})


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        name: what stands in its head.
        unit: of its numbers; stands in the head too.
        format: how a number is written, as in ".2f"; for several numbers in a cell a text with a field for each, as in
            "{:.2f} / {:.2f}".
    """

    name: str
    unit: str = ""
    format: str = ""

    @staticmethod
    def of(text: str) -> list[Column]:
        """Columns from "name; name|unit; name|unit|format"."""
        return [Column(*each.split("|")) for each in text.split("; ")]

    @property
    def head(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def text(self, cell: Cell) -> str:
        """How a cell is written."""
        if cell is None:
            return ""
        if isinstance(cell, str):
            return cell
        return self.format.format(*cell) if isinstance(cell, list) else format(cell, self.format)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(
        ["| " + " | ".join(head) + " |", "|---" * len(head) + "|", *(f"| {' | '.join(r)} |" for r in rows)]
    )


class Table:
    """A table that grows row by row: see :meth:`Results.table`."""

    def __init__(self, title: str, columns: tuple[Column, ...], keep: Callable[[], None]) -> None:
        self._title, self._columns, self._keep = title, columns, keep
        self._rows: list[list[Cell]] = []

    def add(self, *cells: Cell) -> None:
        """Print a row and keep it.

        Raises:
            ValueError: there are more or fewer cells than columns.
        """
        texts = [column.text(cell) for column, cell in zip(self._columns, cells, strict=True)]
        self._rows.append([_storable(cell) for cell in cells])
        print(f"| {' | '.join(texts)} |", flush=True)
        self._keep()

    def content(self, about: dict[str, Any]) -> dict[str, Any]:
        """What the JSON file holds of it; ``about`` is what :func:`circumstances` gives."""
        columns = [
            {name: value for name, value in dataclasses.asdict(column).items() if value or name == "name"}
            for column in self._columns
        ]
        return {"title": self._title, **about, "columns": columns, "rows": self._rows}


def _storable(cell: Cell) -> Cell:
    """JSON has no infinity: it is kept as it reads."""
    return str(cell) if isinstance(cell, float) and not math.isfinite(cell) else cell


def circumstances(device: DeviceInfo | None = None) -> dict[str, Any]:
    """Where, when and by what a result is made: machine, date, command, commit."""
    parts = [device.name] if device is not None else []
    if device is not None and device.kind == "cpu":
        parts.append(device.platform)
    else:
        parts.append(processor())
    return {
        "machine": f"{', '.join(parts)}, {threads()} processors",
        "date": date.today().isoformat(),
        "command": [_command()],
        "commit": _commit(),
    }


def processor() -> str:
    """The processor's name."""
    described = Path("/proc/cpuinfo")
    for line in described.read_text().splitlines() if described.exists() else []:
        if line.startswith("model name"):
            return line.split(":")[1].strip()
    return platform.processor() or platform.machine()


def threads() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def write_json(path: Path, content: Any) -> None:
    """Write a file in one step, so that a run that is cut off leaves the last whole one; in tables each column and each
    row is a line.

    Raises:
        ValueError: a figure is not finite.
    """
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)

    def one_line(match: re.Match[str]) -> str:
        return match[1] + json.dumps(json.loads(match[0]), ensure_ascii=False)

    text = re.sub(r"(?<=\n)(   )([\[{])\n.*?\n   [\]}](?=,?\n)", one_line, text, flags=re.DOTALL)
    with replacing(path) as file:
        file.write(text.encode() + b"\n")


def _command() -> str:
    """The command line of this process."""
    main = getattr(sys.modules["__main__"], "__spec__", None)
    program = ["python", "-m", main.name] if main is not None else ["python", sys.argv[0]]
    return shlex.join([*program, *sys.argv[1:]])


def _commit() -> str:
    """The checkout's commit, with "-dirty" where files differ from it; "unknown" without a checkout."""
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
