"""Make the generated parts of the documentation: python -m tools.make.docs [--check]

- docs/cli.md, from the command line's own parsers;
- the tables between ``<!-- generated: NAME -->`` and ``<!-- end -->`` in other pages, from the code that knows them.

The pages are committed, so that they can be read without building anything. ``--check`` writes nothing and fails if a
page is not as it would be made now.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from tools.make.cli_page import cli_page

ROOT = Path(__file__).parents[2]

#: Tables that other pages hold, and the function that makes each.
_TABLES = {
    "devices": "tools.make.tables:devices_table",
    "figures": "tools.make.benchmarks:figures_table",
    "formats": "tools.make.tables:formats_table",
    "presets": "tools.make.tables:presets_table",
    "quirks": "tools.make.tables:quirks_table",
}


def generated() -> dict[Path, str]:
    """The text that each page should have."""
    pages = {ROOT / "docs" / "cli.md": cli_page()}
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        if path not in pages:
            text = path.read_text("utf-8")
            filled = with_tables(text)
            if filled != text:
                pages[path] = filled
    return pages


def with_tables(text: str) -> str:
    """A page with its generated tables made anew."""

    def table(match: re.Match[str]) -> str:
        module, function = _TABLES[match[2]].split(":")
        made: str = getattr(importlib.import_module(module), function)()
        return f"{match[1]}{made.strip()}\n{match[3]}"

    return re.sub(r"(<!-- generated: (\w+) -->\n)(?:.*?)(<!-- end -->)", table, text, flags=re.DOTALL)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Make the generated parts of the documentation.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a page is not current")
    args = parser.parse_args(argv)
    pages = generated()
    stale = [path for path, text in pages.items() if not path.exists() or path.read_text("utf-8") != text]
    names = ", ".join(str(path.relative_to(ROOT)) for path in stale)
    if args.check:
        if stale:
            print(f"not current: {names}: run python -m tools.make.docs and commit what it changes", file=sys.stderr)
        return 1 if stale else 0
    for path in stale:
        path.write_text(pages[path], "utf-8")
    print(f"written: {names}" if stale else "everything is current")
    return 0


if __name__ == "__main__":
    sys.exit(main())
