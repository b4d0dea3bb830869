"""What the makers of documentation pages share: tables, and the notice that a page is made."""

from __future__ import annotations

from collections.abc import Sequence

NOTICE = "<!-- Made by `python -m tools.make.docs`. Do not edit this page: edit the code that it describes. -->"


def cell(text: str) -> str:
    """Text that stays in one cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])
