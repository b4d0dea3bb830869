"""Put tables that a tool has kept into docs/benchmarks/results: python -m tools.make.benchmark_take

    python -m tools.make.benchmark_take TABLES.json FILE [NAME[=AS] …] [--command COMMAND …] [--remark TEXT]

TABLES.json is what a tool wrote with --json (tools.results), FILE a file of docs/benchmarks/results without its suffix.
The tables NAME, all of them if none is named, replace the results of that name there, or of the name AS. What a page
has decided stays: title, state, which columns are hidden or tell the default, and how many head a transposed table. The
figures, machine, date and commit are the new ones; so is the command, for which --command puts one that anybody
can type, without this machine's paths. ``python -m tools.make.benchmark_pages`` then fills the pages.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from tools.make.benchmark_results import RESULTS, ResultError, checked

#: Parts of a result that the page has decided.
_KEPT = ("title", "state", "transpose", "options")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", type=Path, metavar="TABLES.json")
    parser.add_argument("file", metavar="FILE")
    parser.add_argument("names", nargs="*", metavar="NAME[=AS]")
    parser.add_argument("--command", nargs="+", default=[])
    parser.add_argument("--commit", help="instead of the one that the tables name")
    parser.add_argument("--remark", help="instead of the result's own; an empty one takes it away")
    parser.add_argument("--retitle", action="store_true", help="take the tables' titles, too")
    args = parser.parse_args()
    tables = json.loads(args.tables.read_text(encoding="utf-8"))
    changes: dict[str, Any] = {"command": args.command or None, "commit": args.commit, "remark": args.remark}
    changes = {key: value for key, value in changes.items() if value is not None}
    if args.retitle:
        changes["title"] = None
    try:
        take(tables, RESULTS / f"{args.file}.json", args.names, changes)
    except ResultError as error:
        sys.exit(str(error))


def take(tables: dict[str, Any], path: Path, names: list[str], changes: dict[str, Any]) -> None:
    """Replace results of a file by tables, and write it in the style that it is in.

    Args:
        tables: by name.
        path: of the file; made if there is none.
        names: of the tables to take, as NAME or NAME=AS; empty: all.
        changes: to the parts of every result that is replaced; a title of None is the table's own.

    Raises:
        ResultError: there is no table of a name, its columns are not those of the result that it replaces, or it is not
            what a result must be; then the file stays as it was.
    """
    text = path.read_text(encoding="utf-8") if path.exists() else "{}\n"
    results = json.loads(text)
    for name, _, new in ((*each.partition("="),) for each in names or list(tables)):
        if name not in tables:
            raise ResultError(f"there is no table '{name}', expected one of {', '.join(tables)}")
        results[new or name] = _renewed(results.get(new or name, {}), tables[name], changes)
        checked(f"{path.name}, '{new or name}'", results[new or name])
    path.write_text(_written(results, text), encoding="utf-8")


def _renewed(old: dict[str, Any], table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The result with a table's figures and columns."""
    columns = {column["name"]: column for column in old.get("columns", [])}
    heads = [column["name"] for column in table["columns"]]
    derived = [column for column in old.get("columns", []) if "ratio" in column]
    lost = [part for column in derived for part in column["ratio"] if part not in heads]
    if lost:
        raise ResultError(f"'{table['title']}' has no column '{lost[0]}', which another is derived from")
    stored = [{**column, **columns.get(column["name"], {})} for column in table["columns"]]
    for column in derived:
        place = [each["name"] for each in old["columns"]].index(column["name"])
        if column["name"] not in heads:
            stored.insert(place, column)
    renewed = {**old, **table, **{key: old[key] for key in _KEPT if key in old}, "columns": stored}
    for key, value in changes.items():
        renewed[key] = table["title"] if key == "title" else value
    if renewed.get("remark") == "":
        del renewed["remark"]
    return renewed


def _written(results: dict[str, Any], before: str) -> str:
    """JSON in the style of a file: indented, or with a column and a row a line."""
    for ascii_only in (False, True):
        if json.dumps(json.loads(before), indent=1, ensure_ascii=ascii_only) + "\n" == before:
            return json.dumps(results, indent=1, ensure_ascii=ascii_only) + "\n"
    blocks = []
    for name, result in results.items():
        parts = []
        for key, value in result.items():
            if key in ("columns", "rows", "command"):
                lines = ",\n".join(f"   {json.dumps(line, ensure_ascii=False)}" for line in value)
                parts.append(f'  "{key}": [\n{lines}\n  ]')
            else:
                parts.append(f'  "{key}": {json.dumps(value, ensure_ascii=False)}')
        blocks.append(f" {json.dumps(name)}: {{\n" + ",\n".join(parts) + "\n }")
    return "{\n" + ",\n".join(blocks) + "\n}\n"


if __name__ == "__main__":
    main()
