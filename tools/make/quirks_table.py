"""The workarounds of potr_cl/opencl/quirks.py as a table, for docs/architecture.md: :func:`quirks_table`."""

from __future__ import annotations

from potr_cl.opencl import quirks
from tools.make.markdown import cell, table


def quirks_table() -> str:
    """A row for each quirk."""
    rows = [
        (f"`{name}`", *map(cell, (f"{quirk.vendor}, {quirk.versions}", quirk.reason, quirk.still_needed)))
        for name, quirk in quirks.ALL.items()
    ]
    return table(
        ("quirk", "runtime and versions", "what goes wrong without it", "how to see if it is still needed"), rows
    )
