"""The presets (:data:`PRESETS`): which stages an encode has, in which order, and with which options."""

from __future__ import annotations

from potr_cl.codec.quantize import Preset
from potr_cl.stages.code import Code
from potr_cl.stages.compact import Compact
from potr_cl.stages.fit import Fit
from potr_cl.stages.merge import Merge
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import Stage
from potr_cl.stages.views_between import Between

#: The preset that is taken unless another is asked for.
DEFAULT: Preset = "best"

#: The stages of each preset, in their order. A stage with ``on=False`` is only done if the user asks for it.
PRESETS: dict[Preset, tuple[Stage, ...]] = {
    "best": (
        Between(),
        Prune(),
        Merge(),
        Fit(),
        Compact(on=False),
        Refit(steps="auto"),
        Code(),
    ),
    "smallest": (
        Between(),
        Prune(iterations=32),
        Merge(),
        Fit(steps="auto"),
        Compact(on=False),
        Refit(steps=8, at=(0.5,)),
        Code(),
    ),
    "fast": (
        Between(),
        Prune(iterations=16),
        Merge(),
        Fit(),
        Compact(on=False),
        Refit(steps=4),
        Code(),
    ),
    "paper": (
        Between(views=0, weigh=False),
        Prune(tolerance=0.01),
        Merge(),
        Fit(),
        Compact(),
        Refit(steps=0),
        Code(entropy="zstd"),
    ),
}

#: What each preset is for, in a line.
PURPOSE: dict[Preset, str] = {
    "best": "small files, quickly",
    "smallest": "smaller still: a fit of all parameters; takes several times as long",
    "fast": "fewer iterations and steps: faster, a little larger at equal quality",
    "paper": "the method of the paper: colours compacted splat by splat, zstd",
}


def stages_of(preset: Preset) -> tuple[type[Stage], ...]:
    """The stages of a preset as classes, in their order."""
    return tuple(type(stage) for stage in PRESETS[preset])
