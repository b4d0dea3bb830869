"""Fill the tables of docs/benchmarks and draw its plots: python -m tools.make.benchmark_pages [--check|--ages|--tables]

The pages are prose with markers; between ``<!-- table: encode/stages -->`` and ``<!-- end -->`` this puts the table of
that result (docs/benchmarks/results/encode.json) with its title, and a line with its machine, date and command. Between
``<!-- headlines -->`` and ``<!-- end -->`` stands the list of headlines, whose figures come from the same results.

--check writes nothing; it fails and says what is stale: tables that are not those of the results, plots drawn of other
figures, results that no page shows, history outside of history.md, commands that name no module, links to nowhere,
sentences of README.md with other figures than the results have.
--tables leaves the plots alone, which need matplotlib (the extra "bench").
--ages writes nothing either: it lists the tables by how much the package has changed since they were measured.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import sys
from functools import partial
from pathlib import Path

from tools.make import benchmark_plots
from tools.make.benchmark_ages import ages
from tools.make.benchmark_results import RESULTS, ROOT, Result, ResultError, circumstances, load, table
from tools.make.readme_figures import README, wrong_sentences

PAGES = ROOT / "docs" / "benchmarks"
HISTORY = "history.md"
_BLOCK = re.compile(r"<!-- (?P<what>table: \S+|headlines) -->\n.*?<!-- end -->", re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_MODULE = re.compile(r"python -m (tools(?:\.\w+)+)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, fail if a page or a plot is stale")
    parser.add_argument("--tables", action="store_true", help="do not draw the plots")
    parser.add_argument("--ages", action="store_true", help="list the tables, the most outdated first")
    args = parser.parse_args()
    results = load()
    if args.ages:
        _print_ages(results)
        return
    if args.check:
        found = problems(results)
        for problem in found:
            print(problem, file=sys.stderr)
        sys.exit(1 if found else 0)
    for path, text in filled_pages(results).items():
        path.write_text(text, encoding="utf-8")
    if not args.tables:
        for path in benchmark_plots.draw_all(results):
            print(path)


def _print_ages(results: dict[str, Result]) -> None:
    """A line for each table: commits of the package since, its date and commit, its name and page."""
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(PAGES.glob("*.md"))}
    places = {name: link for path, text in texts.items() for name, (_, link) in _places(path, text).items()}
    print("changes of the package since | date | commit | result | page")
    for age in ages(results):
        changes = "unknown" if age.changes is None else age.changes
        commits = ", ".join(age.commits) or "not said"
        print(f"{changes} | {age.date or 'unknown'} | {commits} | {age.name} | {places.get(age.name, '')}")


def problems(results: dict[str, Result]) -> list[str]:
    """What is stale or wrong in the pages, a line each."""
    found: list[str] = []
    pages = filled_pages(results)
    for path, text in pages.items():
        if path.read_text(encoding="utf-8") != text:
            found.append(f"{path}: stale, run python -m tools.make.benchmark_pages")
    shown = {name: path for path, text in pages.items() for name in _tables(text)}
    found += [f"{RESULTS}: no page shows '{name}'" for name in sorted(set(results) - set(shown))]
    for name, path in shown.items():
        if (results[name].state == "history") != (path.name == HISTORY):
            found.append(f"{path}: '{name}' is {results[name].state}; history, and only that, belongs in {HISTORY}")
    found += [problem for path, text in pages.items() for problem in (*_commands(path, text), *_links(path, text))]
    found += wrong_sentences(results, README.read_text(encoding="utf-8"))
    return found + benchmark_plots.stale(results)


def filled_pages(results: dict[str, Result]) -> dict[Path, str]:
    """Every page's text with its tables filled in.

    Raises:
        ResultError: a page asks for a result that is not there.
    """
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(PAGES.glob("*.md"))}
    places = {name: place for path, text in texts.items() for name, place in _places(path, text).items()}

    def fill(match: re.Match[str], path: Path) -> str:
        what = match["what"]
        if what == "headlines":
            content = _headlines(results, places)
        else:
            name = what.removeprefix("table: ")
            if name not in results:
                raise ResultError(f"{path}: there is no result '{name}' in {RESULTS}")
            content = f"**{results[name].title}**\n\n{table(results[name])}\n\n{circumstances(results[name])}"
        return f"<!-- {what} -->\n\n{content}\n\n<!-- end -->"

    return {path: _BLOCK.sub(partial(fill, path=path), text) for path, text in texts.items()}


def _tables(text: str) -> list[str]:
    """Names of the results that a page shows."""
    return [match["what"].removeprefix("table: ") for match in _BLOCK.finditer(text) if match["what"] != "headlines"]


def _places(path: Path, text: str) -> dict[str, tuple[str, str]]:
    """Where a page shows each of its results: the heading above it, and a link to that."""
    places = {}
    for match in _BLOCK.finditer(text):
        heading = re.findall(r"^#+ (.*)$", text[: match.start()], re.MULTILINE)[-1]
        places[match["what"].removeprefix("table: ")] = heading, f"{path.name}#{_anchor(heading)}"
    return places


def _headlines(results: dict[str, Result], places: dict[str, tuple[str, str]]) -> str:
    """The list of headlines: each a sentence, into which figures of one row of a result are put."""
    lines = ["| | | machine | date | more |", "|---|---|---|---|---|"]
    for entry in json.loads((RESULTS / "headlines.json").read_text(encoding="utf-8")):
        name = entry["result"]
        if name not in results or name not in places:
            raise ResultError(f"headlines.json: no page shows a result '{name}'")
        result = results[name]
        columns = [result.column(each) for each in entry["columns"]]
        wanted = entry["row"]
        rows = [row for row in result.records() if all(row[key] == value for key, value in wanted.items())]
        if len(rows) != 1:
            raise ResultError(f"headlines.json: '{name}' has {len(rows)} rows with {wanted}, not one")
        texts = [f"{column.text(rows[0][column.name])} {column.unit}".strip() for column in columns]
        heading, link = places[name]
        date = result.date or "unknown"
        lines.append(
            f"| {entry['subject']} | {entry['text'].format(*texts)} | {result.machine} | {date} | [{heading}]({link}) |"
        )
    return "\n".join(lines)


def _commands(path: Path, text: str) -> list[str]:
    """Commands of a page that name no module."""
    names = sorted(set(_MODULE.findall(text)))
    return [f"{path}: there is no module {name}" for name in names if not _exists(name)]


def _exists(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _links(path: Path, text: str) -> list[str]:
    """Links of a page to files or headings that are not there."""
    found = []
    for link in sorted(set(_LINK.findall(text))):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists():
            found.append(f"{path}: the link {link} leads to no file")
        elif anchor and target.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            if anchor not in map(_anchor, headings):
                found.append(f"{path}: the link {link} leads to no heading")
    return found


def _anchor(heading: str) -> str:
    """What a heading is called in a link, as GitHub and others name it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


if __name__ == "__main__":
    main()
