"""Text of kernels: files below potr_cl/cl with their headers put in."""

from __future__ import annotations

import re
from importlib.resources import files


def kernel_source(name: str) -> str:
    """Text of ``cl/<name>`` with its ``#include "…"`` lines replaced by the headers, each once."""
    folder = files("potr_cl") / "cl"
    seen: set[str] = set()

    def expand(file: str) -> str:
        def include(match: re.Match[str]) -> str:
            if match[1] in seen:
                return ""
            seen.add(match[1])
            return expand(match[1])

        return re.sub(r'^#include "([\w./]+)"$', include, (folder / file).read_text("utf-8"), flags=re.MULTILINE)

    return expand(name)
