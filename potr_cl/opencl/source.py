"""Text of kernels: files below potr_cl/cl with their headers put in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path


def kernel_source(name: str, variants: Mapping[str, Path] | None = None) -> str:
    """Text of ``cl/<name>`` with its ``#include "…"`` lines replaced by the headers, each once.

    Args:
        name: of the kernel file, as in ``prune/removal_cpu.cl``.
        variants: files to read in place of those of these names, or under names that ``cl/`` does not have.
    """
    variants = variants or {}
    folder = files("potr_cl") / "cl"
    seen: set[str] = set()

    def expand(file: str) -> str:
        def include(match: re.Match[str]) -> str:
            if match[1] in seen:
                return ""
            seen.add(match[1])
            return expand(match[1])

        text = variants.get(file, folder / file).read_text("utf-8")
        return re.sub(r'^#include "([\w./]+)"$', include, text, flags=re.MULTILINE)

    return expand(name)
