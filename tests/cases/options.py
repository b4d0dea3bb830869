"""Options that tests encode with."""

from __future__ import annotations

from typing import Any

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.quantize import Preset
from potr_cl.pipeline.options import EncodeOptions


def as_it_is(preset: Preset = "paper", entropy: EntropyCoder | None = None, **changes: Any) -> EncodeOptions:
    """Options that keep every splat and every colour, and need no views."""
    code = {} if entropy is None else {"entropy": entropy.name, "zstd_level": entropy.level}
    return EncodeOptions(preset=preset).changed(prune=False, compact=False, refit=False, code=code, **changes)
